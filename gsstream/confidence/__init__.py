"""Which Gaussians probably changed."""
