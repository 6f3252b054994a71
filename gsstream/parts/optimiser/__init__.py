"""Optimisers of table rows: how a gradient moves what is trained."""
