"""Written for a major version before the first."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name="from-the-past", target="nowhere:Gate", summary="a gate", api="1.0")]
