"""Which Gaussians take part in a frame."""
