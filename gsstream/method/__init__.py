"""A whole streaming method, coarsely."""
