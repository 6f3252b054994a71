"""What packets promise."""
