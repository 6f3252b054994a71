"""What computes: a renderer with its loss and its row optimiser."""
