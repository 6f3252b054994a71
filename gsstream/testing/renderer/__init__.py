"""What every renderer promises."""
