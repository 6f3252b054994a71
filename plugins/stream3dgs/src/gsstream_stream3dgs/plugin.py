"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """Declare the motion; the Gaussians that a frame adds come from the growth part ``copies``."""
    return [
        ComponentSpec(
            kind="motion",
            name="stream3dgs",
            target="gsstream_stream3dgs.motion:CacheMotion",
            summary="a hash grid and a small network move what is there",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """The paper's setting, and a smaller form."""
    return [
        MethodSpec(
            name="stream3dgs",
            recipe="gsstream_stream3dgs:recipes/stream3dgs.yaml",
            summary="3DGStream: 8 passes for motion, 5 for the frame's own Gaussians; its network is sent",
        ),
        MethodSpec(
            name="stream3dgs-cells",
            recipe="gsstream_stream3dgs:recipes/stream3dgs-cells.yaml",
            summary="3DGStream, sent as rigid motions of small cells: a tenth of the bytes, less quality",
        ),
    ]
