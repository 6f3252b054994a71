"""Written for a newer minor version; also uses a hook that this version does not know."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name="newer-gate", target="nowhere:Gate", summary="a gate", api="3.3")]


@hookimpl
def gsstream_viewers():
    return []
