"""Sweeps: recipes x scenes x seeds, run by workers, in one append-only table."""
