"""Of an older major version, and of a kind that has another name since."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="whole", name="hicom", target="nowhere:HiCoM", summary="a method", api="1.0")]
