"""0/1 straight-through gates as a part of gsstream. Importing this package imports no torch."""
