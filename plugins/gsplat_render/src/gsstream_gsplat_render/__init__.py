"""The renderer part `gsplat`: CUDA rasterisation through the gsplat library."""
