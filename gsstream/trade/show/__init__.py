"""Pictures of a run: curves over frames, contact sheets, and the gallery of a run folder."""
