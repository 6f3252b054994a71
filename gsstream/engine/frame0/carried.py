"""What an encoder takes over from a stream: numbers that its meta carries, and a scene of other coordinates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.errors import PacketError
from gsstream.core.shapes import FloatArray
from gsstream.core.world import World
from gsstream.packet import PlayerState


def numbers(value: Any, shape: tuple[int, ...], key: str) -> FloatArray:
    """Return an entry of a stream's ``extra`` as float32.

    Arguments:
        value: what the meta holds; None where it holds nothing.
        shape: that it must have.
        key: its name in ``extra``, for the error.

    Raises PacketError when it is missing, or not finite numbers of this shape.
    """
    try:
        with np.errstate(over="ignore"):  # what does not fit into float32 becomes infinite and is refused
            array = np.asarray(value, np.float64).astype(np.float32)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0, np.float32)
    if array.shape != shape or not np.isfinite(array).all():
        raise PacketError(
            f"meta: extra.{key}: expected finite numbers {list(shape)}, got {str(value)[:40]!r}; the stream cannot be "
            "encoded further, only played"
        )
    return array


def in_world(first: PlayerState, world: World) -> PlayerState:
    """Return a decoded scene in the coordinates of another stream of the same recording.

    Streams of one recording share their coordinates, unless an earlier version wrote one, or its cameras were changed.

    Arguments:
        first: what players have of a frame.
        world: of the recording that is encoded.
    """
    if first.meta.world.is_near(world):
        return first
    move = world.inverse().after(first.meta.world)
    scene, layout = move.gaussians(first.gaussians), first.layout
    moved = replace(
        first.scene,
        gaussians=scene.map(lambda values: np.asarray(values, np.float32)),
        layout=replace(layout, units=np.asarray(layout.units * move.scale, np.float32)),
    )
    train, test = move.cameras(first.meta.train), move.cameras(first.meta.test)
    return replace(first, scene=moved, meta=replace(first.meta, world=world, train=train, test=test))
