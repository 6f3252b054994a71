"""What this plugin offers to gsstream. Imports neither torch nor gsplat."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The renderer `gsplat`."""
    return [
        ComponentSpec(
            kind="renderer",
            name="gsplat",
            target="gsstream_gsplat_render.renderer:GsplatRenderer",
            summary="CUDA rasteriser (gsplat library), with tile masks; needs an NVIDIA GPU",
        )
    ]
