"""What this plugin offers to gsstream. Imports no torch and no native code."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The renderer, the loss and the optimiser `cpu`."""
    return [
        ComponentSpec(
            kind="renderer",
            name="cpu",
            target="gsstream_cpu_render.renderer:CpuRenderer",
            summary="fast CPU rasteriser (C++20, SIMD), with tile masks and cached frozen Gaussians",
        ),
        ComponentSpec(
            kind="loss",
            name="cpu",
            target="gsstream_cpu_render.loss_part:CpuLoss",
            summary="native L1 + D-SSIM with its gradient, on tile masks",
        ),
        ComponentSpec(
            kind="optimiser",
            name="cpu",
            target="gsstream_cpu_render.adam_part:CpuAdam",
            summary="native Adam by rows, fused and threaded",
        ),
    ]
