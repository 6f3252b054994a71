"""Closes the standard output, as a library does that takes it for a file of its own."""

import sys

from gsstream.spec import ComponentSpec, hookimpl

sys.stdout.close()


@hookimpl
def gsstream_components():
    target = "gsstream.parts.gate.always_open:AlwaysOpen"
    return [ComponentSpec(kind="gate", name="mine", target=target, summary="mine")]
