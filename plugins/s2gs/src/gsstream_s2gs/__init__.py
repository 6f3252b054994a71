"""S2GS: structured sparse Gaussian streaming, written as parts of gsstream. Importing this package imports no torch."""
