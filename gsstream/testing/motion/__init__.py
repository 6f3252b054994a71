"""What every motion part promises."""
