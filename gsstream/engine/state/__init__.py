"""What the encoder carries from frame to frame."""
