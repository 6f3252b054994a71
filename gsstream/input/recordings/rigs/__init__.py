"""One file per format of calibration that comes without pictures."""
