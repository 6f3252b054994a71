"""What every regularizer promises."""
