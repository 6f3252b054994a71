"""How a gated change is applied to the previous Gaussians."""
