"""QUEEN as a whole method. Importing this package imports no torch."""
