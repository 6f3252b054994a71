"""What every growth part promises."""
