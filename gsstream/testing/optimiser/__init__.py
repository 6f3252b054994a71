"""What every row optimiser promises."""
