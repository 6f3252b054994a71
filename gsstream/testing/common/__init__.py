"""What parts of all kinds promise."""
