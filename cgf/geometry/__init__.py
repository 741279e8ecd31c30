"""Rigid motions, neighbours, downsampling, normals and local frames."""
