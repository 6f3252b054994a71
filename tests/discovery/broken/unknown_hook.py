"""Misspells the hook."""

from gsstream.spec import hookimpl


@hookimpl
def gsstream_component():
    return []
