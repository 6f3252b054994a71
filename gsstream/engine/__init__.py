"""The encoder: the only code that uses all rooms, because rooms do not import each other."""
