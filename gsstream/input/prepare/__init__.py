"""Scenes before a run: prepare one from raw recordings, and say what is wrong with one."""
