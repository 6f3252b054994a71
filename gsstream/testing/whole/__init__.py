"""What every method promises, made of parts or whole."""
