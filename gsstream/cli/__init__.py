"""Thin commands; nothing heavy is imported at the top level."""
