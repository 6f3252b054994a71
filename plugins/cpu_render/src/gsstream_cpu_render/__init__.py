"""Fast differentiable Gaussian-splatting rasteriser for CPUs, a renderer plugin of gsstream. Importing it imports no torch."""
