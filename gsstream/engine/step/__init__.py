"""One later frame."""
