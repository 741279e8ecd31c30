"""Compact Geometric Features: learned descriptors of points, and what uses them."""
