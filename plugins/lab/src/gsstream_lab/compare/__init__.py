"""Methods side by side: one recording, one frame 0, one page."""
