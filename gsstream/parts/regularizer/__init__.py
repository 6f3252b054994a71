"""What openness and motion cost."""
