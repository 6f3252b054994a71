"""A scene that is taken over from a stream of other coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsstream.core.world import World
from gsstream.packet import PlayerState


def to_stream_coordinates(first: PlayerState, world: World) -> PlayerState:
    """Return a decoded scene in the coordinates of another stream of the same recording.

    Streams of one recording share their coordinates, unless an earlier version wrote one, or its cameras were changed.
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
