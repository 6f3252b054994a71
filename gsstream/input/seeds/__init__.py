"""The first frame: points, seeds and their schedule."""
