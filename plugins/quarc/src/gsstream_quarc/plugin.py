"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The method as one part."""
    return [
        ComponentSpec(
            kind="streaming_method",
            name="quarc",
            target="gsstream_quarc.method:QuARC",
            summary="rounded motions of anchors on three levels, Gaussians added where four views changed",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """The letter, and what it costs less to do."""
    return [
        MethodSpec(
            name="quarc",
            recipe="gsstream_quarc:recipes/quarc.yaml",
            summary="QuARC-GS: 10 epochs, moving what changed",
        ),
        MethodSpec(
            name="quarc-published",
            recipe="gsstream_quarc:recipes/quarc-published.yaml",
            summary="QuARC-GS as printed: everything may move",
        ),
    ]
