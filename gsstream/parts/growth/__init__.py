"""Which Gaussians are born and which leave after a frame was optimised."""
