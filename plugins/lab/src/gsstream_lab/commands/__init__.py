"""The commands that this plugin adds to ``gsstream``; each imports what it needs when it runs."""
