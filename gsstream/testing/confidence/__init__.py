"""What every confidence estimator promises."""
