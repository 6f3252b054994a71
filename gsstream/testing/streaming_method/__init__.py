"""What every method promises, whatever steps it from frame to frame."""
