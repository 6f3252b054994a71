"""What every update rule promises."""
