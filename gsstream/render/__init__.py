"""Pixels from Gaussians, differentiably."""
