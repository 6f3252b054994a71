"""Returns names instead of specs."""

from gsstream.spec import hookimpl


@hookimpl
def gsstream_components():
    return ["my-gate"]
