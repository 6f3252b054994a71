"""One codec for each kind of change that a delta packet may hold (``core.changes``)."""
