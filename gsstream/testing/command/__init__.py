"""Checks of commands that plugins add to ``gsstream``."""
