"""Live cameras: read, paired, written as a folder that grows, and calibrated with a board."""
