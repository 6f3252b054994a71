"""All that comes in: recordings, their preparation and validation, and the points that frame 0 starts from."""
