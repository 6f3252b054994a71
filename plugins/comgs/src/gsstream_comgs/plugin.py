"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """What moves, and what is corrected."""
    return [
        ComponentSpec(
            kind="motion",
            name="keypoints",
            target="gsstream_comgs.motion:KeyPointMotion",
            summary="two hundred key points move what is around them",
        ),
        ComponentSpec(
            kind="confidence",
            name="error-gradient",
            target="gsstream_comgs.confidence:ErrorGradient",
            summary="the share of the Gaussians with the largest gradient of the error",
        ),
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """The two lengths of the paper."""
    return [
        MethodSpec(
            name="comgs-s", recipe="gsstream_comgs:recipes/comgs-s.yaml", summary="ComGS-s: corrections every 10 frames"
        ),
        MethodSpec(
            name="comgs-l", recipe="gsstream_comgs:recipes/comgs-l.yaml", summary="ComGS-l: corrections every 2 frames"
        ),
    ]
