"""Long recordings in segments: each starts with a key packet of its own, so several can be encoded at a time."""
