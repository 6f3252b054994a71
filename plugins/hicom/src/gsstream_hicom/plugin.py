"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The method as one part."""
    return [
        ComponentSpec(
            kind="streaming_method",
            name="hicom",
            target="gsstream_hicom.method:HiCoM",
            summary="rigid motion of the cells of three nested grids, Gaussians added and removed at constant number",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """The letter, and what it costs less to do."""
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
