"""3DGStream for gsstream. Importing this package imports no torch."""
