"""A lamp is switched on or off: what all cameras see becomes brighter by one factor, and the whole scene with it.

Without it every pixel is a change like any other, and every Gaussian asks for bits. So the factor is looked for before
anything else is, in every later frame, from a few pixels of each camera; scene, background and the pictures that the
frame is compared with are multiplied by it, and what is left is what changed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Light, apply_light, lit_background, sendable_factor
from gsstream.core.changes.light import MOST_FACTOR
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.drift import looked_at
from gsstream.engine.state.stream_state import StreamState
from gsstream.packet import PlayerState

#: About so many pixels of a picture are looked at.
PIXELS = 1024
#: Levels of 255 between which a channel of a pixel tells by how much it became brighter: below are noise and what a
#: camera rounds, above what it cuts off.
DARKEST, BRIGHTEST = 12.0, 250.0
#: Least share by which a channel must have become brighter or darker: slower changes are followed by the colours.
LEAST = 0.02
#: Share of a camera's difference, in the median, that may be left when the factor is taken out; share of the cameras
#: for which this must hold; and least number of pixels that a camera must have.
MOST_LEFT, MOST_CAMERAS, FEWEST = 0.5, 0.75, 24
#: Bytes of a packet that holds nothing else: its header, and a section of six bytes.
LEAST_BYTES = 27
#: Levels within which a pixel does what most do.
ALIKE = 8.0


def switched(assembly: Assembly, state: StreamState, frame: Frame) -> Light | None:
    """Return the factor by which everything became brighter since the frame that the scene shows; None without one.

    It is asked for where the colours follow the light (``stream.light``). One camera alone has no say, whose exposure
    may have changed; of two both must agree.
    """
    if assembly.recipe.stream.light == 0 or len(frame.images) < 2:
        return None
    first, then = _looked_at(state.previous.images), _looked_at(frame.images)
    tells = (np.minimum(first, then) > DARKEST) & (np.maximum(first, then) < BRIGHTEST)
    count, least = tells.sum(2, keepdims=True), MOST_CAMERAS * len(first)
    share = np.sort(np.where(tells, then, 1e9) / first.clip(1), 2)
    share = np.take_along_axis(share, count // 2, 2)  # in the median of those that tell
    alike = tells & (np.abs(then - share * first) < ALIKE)
    brighter = (then * alike).sum(2) / (first * alike).sum(2).clip(1)
    enough = count[..., 0] >= FEWEST
    told = enough.sum(0) >= least  # a room without blue light says nothing of blue
    if not told.any():
        return None
    factor = np.array([np.median(brighter[enough[:, c], c]) if told[c] else np.nan for c in range(3)])
    factor = np.where(told, factor, np.nanmedian(factor)).clip(1 / MOST_FACTOR, MOST_FACTOR)
    changed = told & (np.abs(np.log(factor)) >= np.log1p(LEAST))
    if not changed.any():
        return None
    expected = np.minimum(first * factor[:, None], 255)
    left, whole = (np.median(np.abs(then - other)[:, changed], (1, 2)) for other in (expected, first))
    return Light(sendable_factor(factor)) if np.count_nonzero(left <= MOST_LEFT * whole) >= least else None


class Lamp(NamedTuple):
    """A frame's beginning: the factor, the state and the parts in its light; as they were where there is no factor."""

    assembly: Assembly
    state: StreamState
    light: Light | None


def with_lamp(assembly: Assembly, state: StreamState, frame: Frame, max_bytes: int | None, log: FrameLog) -> Lamp:
    """Return the state that the rest of a frame begins with. A factor is not looked for where it would not fit."""
    if max_bytes is not None and max_bytes < LEAST_BYTES:
        return Lamp(assembly, state, None)
    light = switched(assembly, state, frame)
    if light is None:
        return Lamp(assembly, state, None)
    log.set(light=list(light.factor))
    state = in_light(state, light)
    return Lamp(in_light_of(assembly, state.player), state, light)


def in_light(state: StreamState, light: Light) -> StreamState:
    """Return the state as if the scene had always been in this light: what players have, and the pictures it shows."""
    shown = state.previous
    lit = state.lit or looked_at(shown.index, FrameImages(shown.images, torch.device("cpu")), state.gains)
    return replace(
        state,
        player=lit_player(state.player, light),
        previous=lit_frame(shown, light),
        lamps=(*state.lamps, light),
        lit=lit.in_light(light.factor),
        session=None,
        resident=None,
    )


def in_light_of(assembly: Assembly, player: PlayerState) -> Assembly:
    """Return the parts of a run before the background that players have."""
    return replace(assembly, background=player.meta.background)


def lit_player(player: PlayerState, light: Light) -> PlayerState:
    """Return what players have of a frame, in another light."""
    background = lit_background(player.meta.background, light)
    return replace(player, scene=apply_light(player.scene, light), meta=replace(player.meta, background=background))


def lit_frame(frame: Frame, light: Light) -> Frame:
    """Return a frame whose pictures, as they are stored, are in another light."""
    return replace(frame, images=np.stack([scaled(torch.from_numpy(image), light).numpy() for image in frame.images]))


def resumed_in_light(state: StreamState, players: Iterable[PlayerState]) -> StreamState:
    """Return the state of a stream that is resumed, with ``previous`` in the light of its end.

    Arguments:
        players: their states since the last key packet.
    """
    lamps: tuple[Light, ...] = ()
    for player in players:
        if player.delta is not None:
            lamps = (*lamps, *([player.delta.light] if player.delta.light else []))
            lamps = lamps if player.delta.is_light_at_most else ()
    for lamp in lamps:
        state = replace(state, previous=lit_frame(state.previous, lamp))
    return replace(state, lamps=lamps)


def scaled(pixels: torch.Tensor, light: Light) -> torch.Tensor:
    """Return pixels [..., 3] in another light, of the type in which they are stored."""
    brighter = pixels.float() * pixels.new_tensor(light.factor, dtype=torch.float32)
    if pixels.dtype == torch.uint8:
        return brighter.round().clamp(0, 255).to(torch.uint8)
    return brighter.clamp(0, 1)


def _looked_at(images: FloatArray) -> FloatArray:
    """Pixels [V, 3, P] of images [V, H, W, 3] as they are stored, levels of 255."""
    count, height, width = images.shape[:3]
    step = max(math.isqrt(height * width // PIXELS), 1)
    some = images[:, step // 2 :: step, step // 2 :: step].reshape(count, -1, 3)
    pixels = some.transpose(0, 2, 1).astype(np.float32, order="C")
    return pixels if images.dtype == np.uint8 else pixels * np.float32(255)
