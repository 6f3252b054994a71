"""What a run cost and what it gave: summaries, plots, contact sheets."""
