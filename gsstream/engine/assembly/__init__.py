"""From a recipe and the catalogue to live parts, each guarded once."""
