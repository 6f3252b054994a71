"""Finding parts that others wrote."""
