"""Parts that pass every check of their kind, one file per kind: new plugins start from them."""
