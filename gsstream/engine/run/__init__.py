"""A run on disk: session, metrics, progress, output folder."""
