"""Describes a part that no slot takes."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gatte", name="my-gate", target="nowhere:Gate", summary="a gate")]
