"""Soak: hours of generated scenes through random valid recipes, each stream held against its encoder bit by bit."""
