"""What every propagation promises."""
