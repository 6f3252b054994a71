"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """Declare the motion; Gaussians are added and removed by the growth part ``copies``."""
    return [
        ComponentSpec(
            kind="motion",
            name="hicom",
            target="gsstream_hicom.motion:CoherentMotion",
            summary="rigid motion of the cells of three nested grids",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """Declare the method and its variants."""
    return [
        MethodSpec(
            name="hicom",
            recipe="gsstream_hicom:recipes/hicom.yaml",
            summary="HiCoM: 10 epochs, moving what changed",
        ),
        MethodSpec(
            name="hicom-published",
            recipe="gsstream_hicom:recipes/hicom-published.yaml",
            summary="HiCoM as printed: every cell moves",
        ),
    ]
