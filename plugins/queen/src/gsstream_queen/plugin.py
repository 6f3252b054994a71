"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The method as one part."""
    return [
        ComponentSpec(
            kind="streaming_method",
            name="queen",
            target="gsstream_queen.method:Queen",
            summary="quantised latent residuals of all Gaussians, hard-concrete gates of positions, densification",
        )
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """Declare the method and its variants."""
    return [
        MethodSpec(
            name="queen",
            recipe="gsstream_queen:recipes/queen.yaml",
            summary="QUEEN: 10 epochs, training what changed",
        ),
        MethodSpec(
            name="queen-published",
            recipe="gsstream_queen:recipes/queen-published.yaml",
            summary="QUEEN-l as printed: 10 epochs, training everything",
        ),
        MethodSpec(name="queen-m", recipe="gsstream_queen:recipes/queen-m.yaml", summary="QUEEN-m: 8 epochs"),
        MethodSpec(name="queen-s", recipe="gsstream_queen:recipes/queen-s.yaml", summary="QUEEN-s: 6 epochs"),
    ]
