"""Fast differentiable Gaussian splatting on CPUs, a renderer plugin of gsstream. Importing it imports no torch."""
