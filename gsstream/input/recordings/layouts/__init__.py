"""One file per on-disk layout that gsstream reads."""
