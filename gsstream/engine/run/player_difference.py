"""What differs between the scene that players have after a packet and the one that a method goes on from."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.gaussians import ATTRIBUTES
from gsstream.packet import PlayerState


def difference_between(player: PlayerState, claimed: PlayerState) -> str:
    """Describe what differs between two player states; empty when nothing does."""
    if player.frame != claimed.frame:
        return f"frame {claimed.frame} instead of {player.frame}"
    for name in ATTRIBUTES:
        want, got = getattr(player.gaussians, name), getattr(claimed.gaussians, name)
        if want.shape != got.shape:
            return f"{name} has the shape {list(got.shape)} instead of {list(want.shape)}"
        if want.tobytes() != got.tobytes():
            return f"{name} is off by up to {float(np.abs(got - want).max()):.3g}"
    for name in ("node_counts", "unit_of", "units"):
        if not np.array_equal(getattr(player.layout, name), getattr(claimed.layout, name)):
            return f"layout: {name}"
    if set(player.decoders) != set(claimed.decoders) or any(
        value.tobytes() != claimed.decoders[name].tobytes() for name, value in player.decoders.items()
    ):
        return "decoders"
    return _history_difference(player, claimed)


def _history_difference(player: PlayerState, claimed: PlayerState) -> str:
    """Describe what differs in what later motions are predicted from; empty when nothing does."""
    memory = {
        "displacement": ("rows", "translation", "rotation"),
        "groups": ("cell", "brightness_bins", "count", "group_of"),
    }
    for name, fields in memory.items():
        want, got = getattr(player.scene, name), getattr(claimed.scene, name)
        if want is None and got is None:
            continue
        if want is None or got is None:
            return f"scene: {name}"
        for field in fields:
            if not _same(getattr(want, field), getattr(got, field)):
                return f"scene: {name}, {field}"
    return ""


def _same(want: float | np.ndarray[Any, Any], got: float | np.ndarray[Any, Any]) -> bool:
    """Return whether two numbers are equal, or two arrays bit by bit."""
    if isinstance(want, np.ndarray) and isinstance(got, np.ndarray):
        return want.tobytes() == got.tobytes()
    return bool(np.array_equal(want, got))
