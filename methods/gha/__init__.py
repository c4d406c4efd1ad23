"""Gaussian Head Avatar: a mesh head that starts a head of Gaussians, drawn as features and brought to full size."""
