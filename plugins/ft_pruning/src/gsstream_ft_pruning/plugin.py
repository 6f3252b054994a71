"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        ComponentSpec(
            kind="propagation",
            name="ft-pruning",
            target="gsstream_ft_pruning.fixed_threshold:FixedThreshold",
            summary="drops confidences below a fixed threshold, then takes the maximum over each tree",
        )
    ]
