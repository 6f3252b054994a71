"""What crosses the wire. Imports no torch."""
