"""Fixed-threshold pruning as a propagation of gsstream. Importing this package imports no torch."""
