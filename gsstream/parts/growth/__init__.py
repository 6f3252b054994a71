"""Which Gaussians are added and which are removed after a frame was optimised."""
