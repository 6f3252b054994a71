"""How Gaussians are grouped."""
