"""Calibration of a rig with a printed board."""
