"""A run described as data."""
