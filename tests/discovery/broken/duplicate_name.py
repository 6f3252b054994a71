"""Claims a name that the built-in parts use, beside one that is free."""

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [
        ComponentSpec(kind="gate", name="free-name", target="nowhere:Gate", summary="a gate"),
        ComponentSpec(kind="gate", name="always-open", target="nowhere:Gate", summary="another gate"),
    ]
