"""A change or flow network of your own as confidence in gsstream. Importing this package imports no torch."""
