"""Benchmarks: what a renderer and a frame step cost on this machine, beside what they cost at least."""
