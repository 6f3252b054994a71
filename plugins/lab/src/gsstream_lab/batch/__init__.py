"""Many recordings with one method: a list in, a stream for each out, wherever the workers are."""
