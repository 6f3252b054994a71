"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The method as one part."""
    return [
        ComponentSpec(
            kind="streaming_method",
            name="comgs",
            target="gsstream_comgs.method:ComGS",
            summary="two hundred key points move what is around them; masked corrections at key frames",
        )
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
