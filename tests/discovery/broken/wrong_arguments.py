"""Asks for an argument that the hook does not have."""

from gsstream.spec import hookimpl


@hookimpl
def gsstream_components(registry):
    return []
