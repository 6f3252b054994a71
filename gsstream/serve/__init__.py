"""Streams on the web: folders for static servers. Reads streams, decodes no more than it must, knows no training."""
