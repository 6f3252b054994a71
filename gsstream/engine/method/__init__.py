"""The method made of parts, and how any method is called and held to its contract."""
