"""What this plugin offers to gsstream. Imports no torch and no native code."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The renderer `cpu`, which brings its loss and its row optimiser."""
    return [
        ComponentSpec(
            kind="renderer",
            name="cpu",
            target="gsstream_cpu_render.renderer:CpuRenderer",
            summary="fast CPU rasteriser (C++20, SIMD), with tile masks and cached frozen Gaussians",
        ),
    ]
