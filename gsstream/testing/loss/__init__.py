"""What every loss promises."""
