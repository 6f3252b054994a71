"""QuARC-GS for gsstream. Importing this package imports no torch."""
