"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """Declare the motion; Gaussians are added and removed by the growth part ``copies``."""
    return [
        ComponentSpec(
            kind="motion",
            name="recon",
            target="gsstream_recon.motion:AnchorMotion",
            summary="motions of anchors on three levels add up",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """Declare the method and its variants."""
    return [
        MethodSpec(
            name="recon",
            recipe="gsstream_recon:recipes/recon.yaml",
            summary="ReCon-GS: 10 epochs, moving what changed",
        ),
        MethodSpec(
            name="recon-published",
            recipe="gsstream_recon:recipes/recon-published.yaml",
            summary="ReCon-GS as printed: everything moves",
        ),
    ]
