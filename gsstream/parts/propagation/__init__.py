"""How belief spreads over the hierarchy."""
