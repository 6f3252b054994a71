"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        ComponentSpec(
            kind="gate",
            name="binary-ste",
            target="gsstream_binary_ste.binary:BinarySteGate",
            summary="gates are 0 or 1, with a straight-through gradient",
        )
    ]
