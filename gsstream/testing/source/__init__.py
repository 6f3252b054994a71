"""What every source promises."""
