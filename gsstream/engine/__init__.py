"""The corridor: the only code that walks through the rooms."""
