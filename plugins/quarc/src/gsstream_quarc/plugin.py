"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """Declare the growth part; the motion is the part of ReCon-GS with rounded motions."""
    return [
        ComponentSpec(
            kind="growth",
            name="change-gated-copies",
            target="gsstream_quarc.growth:ChangeGatedCopies",
            summary="Gaussians copied where four views changed",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """Declare the method and its variants."""
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
