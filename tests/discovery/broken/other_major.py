"""Written for another major version of the component API."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name="from-the-future", target="nowhere:Gate", summary="a gate", api="4.0")]
