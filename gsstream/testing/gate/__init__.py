"""What every gate sampler promises."""
