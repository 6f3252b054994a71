"""What every structure promises."""
