"""Decode and look. Knows no training and no torch."""
