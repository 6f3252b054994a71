"""Values that the scene decides before frame 0."""
