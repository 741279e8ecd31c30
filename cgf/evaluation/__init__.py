"""How good correspondences and motions are, measured against known poses."""
