"""A lamp is switched on or off: what all cameras see becomes brighter by one factor, and the whole scene with it.

Without it every pixel is a change like any other, and every Gaussian asks for bits. So the factor is looked for before
anything else is, in every later frame, from a few pixels of each camera; scene, background and the pictures that the
frame is compared with are multiplied by it, and what is left is what changed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Light, apply_light, lit_background, sendable_factor
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.core.storage import to_bytes, unpacked
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.drift import Lit, looked_at
from gsstream.engine.state.stream_state import StreamState
from gsstream.packet import PlayerState

#: About so many pixels of a picture are looked at.
PIXELS = 1024
#: Levels of 255 between which a channel of a pixel tells by how much it became brighter: below are noise and what a
#: camera rounds, above what it cuts off.
DARKEST, BRIGHTEST = 12.0, 250.0
#: Least share by which a channel must have become brighter or darker: slower changes are followed by the colours.
LEAST = 0.02
#: The same in the dark, mean levels of 255 of what the room looked like in the light.
LEAST_LEVELS = 2.0
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
    first, then = _levels(state.previous.images), _levels(frame.images)
    tells = (np.minimum(first, then) > DARKEST) & (np.maximum(first, then) < BRIGHTEST)
    found = _brighter(first, then, tells)
    if found is None:
        return _after_dark(state, frame)
    factor, told = found
    changed = told & (np.abs(np.log(factor)) >= np.log1p(LEAST))
    return _light(factor, changed, then, before=first, expected=first * factor[:, None])


def _after_dark(state: StreamState, frame: Frame) -> Light | None:
    """The factor of a lamp that leaves no light, or that is switched on in the dark; None without one.

    The last picture, or this one, says nothing of it. What the room looked like in the light does: the frame whose
    light the colours have, and the lamps that were switched since.
    """
    lit, now = _lit(state), looked_at(frame.index, FrameImages(frame.images, torch.device("cpu")), None)
    before, then = (_levels(each.pixels[0].cpu().numpy()) for each in (lit, now))
    found = _brighter(before, then, (before > 2 * DARKEST) & (np.maximum(before, then) < BRIGHTEST))
    if found is None:
        return None
    brighter, told = found
    lamps = np.array(lit.lamps)
    changed = told & (np.abs(brighter - lamps) * before.mean((0, 2)) > LEAST_LEVELS)
    had = before * lamps[:, None]
    return _light(brighter / lamps, changed, then, before=had, expected=before * brighter[:, None])


def _brighter(first: FloatArray, then: FloatArray, tells: BoolArray) -> tuple[FloatArray, BoolArray] | None:
    """[3] by how much most pixels that tell became brighter, in the median of the cameras, and which channels tell.

    A channel that does not takes the factor of the others: a room without blue light says nothing of blue. None: none
    tells.
    """
    count = tells.sum(2, keepdims=True)
    share = np.sort(np.where(tells, then, 1e9) / first.clip(1), 2)
    share = np.take_along_axis(share, count // 2, 2)  # in the median of those that tell
    alike = tells & (np.abs(then - share * first) < ALIKE)
    ratio = (then * alike).sum(2) / (first * alike).sum(2).clip(1)
    enough = count[..., 0] >= FEWEST
    told = enough.sum(0) >= MOST_CAMERAS * len(first)
    if not told.any():
        return None
    factor = np.array([np.median(ratio[enough[:, c], c]) if told[c] else np.nan for c in range(3)])
    return np.where(told, factor, np.nanmedian(factor)), told


def _light(
    factor: FloatArray, changed: BoolArray, then: FloatArray, *, before: FloatArray, expected: FloatArray
) -> Light | None:
    """The factor, where it leaves little of what changed in most cameras; ``changed``: channels it is about."""
    if not changed.any():
        return None
    left, whole = (np.median(np.abs(then - each.clip(0, 255))[:, changed], (1, 2)) for each in (expected, before))
    explained = np.count_nonzero(left <= MOST_LEFT * whole)
    return Light(sendable_factor(factor)) if explained >= MOST_CAMERAS * len(then) else None


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
    log.set(lamp=list(light.factor))
    state = in_light(state, light)
    return Lamp(replace(assembly, background=state.player.meta.background), state, light)


def in_light(state: StreamState, light: Light) -> StreamState:
    """Return the state as if the scene had always been in this light: what players have, and the pictures it shows."""
    return replace(
        state,
        player=lit_player(state.player, light),
        previous=lit_frame(state.previous, light),
        earlier=None,
        lamps=(*state.lamps, light),
        lit=_lit(state).in_light(light.factor),
        session=None,
        resident=None,
        pictures=None,
    )


def _lit(state: StreamState) -> Lit:
    """The frame whose light the colours have; without one, that which the scene shows."""
    shown = state.previous
    return state.lit or looked_at(shown.index, FrameImages(shown.images, torch.device("cpu")), state.gains)


def lit_player(player: PlayerState, light: Light) -> PlayerState:
    """Return what players have of a frame, in another light."""
    background = lit_background(player.meta.background, light)
    return replace(player, scene=apply_light(player.scene, light), meta=replace(player.meta, background=background))


def lit_frame(frame: Frame, light: Light) -> Frame:
    """Return a frame whose pictures, as they are stored, are in another light."""
    stored = to_bytes if frame.images.dtype == np.uint8 else partial(np.clip, a_min=0, a_max=1)
    factor = np.asarray(light.factor, np.float32)
    # View by view: as float32 all of them would take four times their memory.
    return replace(frame, images=np.stack([stored(unpacked(image) * factor) for image in frame.images]))


def resumed_in_light(state: StreamState, players: Iterable[PlayerState]) -> StreamState:
    """Return the state of a stream that is resumed, with ``previous`` in the light of its end.

    Arguments:
        players: their states since the last key packet.
    """
    lamps: tuple[Light, ...] = ()
    for delta in (player.delta for player in players if player.delta is not None):
        if not delta.is_light_at_most:
            lamps = ()
        elif delta.light is not None:
            lamps = (*lamps, delta.light)
    for lamp in lamps:
        state = replace(state, previous=lit_frame(state.previous, lamp))
    return replace(state, lamps=lamps)


def _levels(images: FloatArray) -> FloatArray:
    """Some pixels [V, 3, P] of images [V, H, W, 3] as they are stored, levels of 255."""
    count, height, width = images.shape[:3]
    step = max(math.isqrt(height * width // PIXELS), 1)
    some = images[:, step // 2 :: step, step // 2 :: step].reshape(count, -1, 3)
    pixels = some.transpose(0, 2, 1).astype(np.float32, order="C")
    return pixels if images.dtype == np.uint8 else pixels * np.float32(255)
