"""Later key packets, and going on from a stream."""
