"""A frame at work, for parts that act inside one: the third frame of a tiny recording, some Gaussians on the move."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Scene
from gsstream.core.log import FrameLog
from gsstream.core.part import Part
from gsstream.core.rng import Rng
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.engine.step.context import EngineContext
from gsstream.input.recordings.open import open_source
from gsstream.metrics.psnr import psnr
from gsstream.parts.backend.change import Change, find_change
from gsstream.player.render import named_renderer, render
from gsstream.testing.method_driver import FRAMES, SOURCE, MethodUnderTest, check_replay

#: Sigmas beyond which tiles count as changed.
THRESHOLD = 6.0
#: Index that the frame at work is given: none of those in which a chain is encoded.
INDEX = 7


class FitFixture(NamedTuple):
    """Arguments of a part: the decoded scene, the frame that it works on, random streams."""

    scene: Scene
    work: EngineContext
    rng: Rng


@functools.lru_cache(maxsize=1)
def _before() -> tuple[MethodUnderTest, EncodedFrame]:
    """A dense method, and its step of frame 1: some rows were displaced."""
    method = MethodUnderTest("dense")
    return method, method.chain()[1]


def fit_fixture(*, changed: bool = True) -> FitFixture:
    """Return frame 2 of a tiny recording, to be worked on; with ``changed`` false no tile counts as changed."""
    method, step = _before()
    state, frame = step.state, open_source(SOURCE).frame(2)
    before, now = (FrameImages(each.images, torch.device("cpu")).all_stored() for each in (state.previous, frame))
    change = find_change(before, now, THRESHOLD)
    if not changed:
        change = Change(torch.zeros_like(change.tiles), change.height, change.width)
    frame = replace(frame, index=INDEX, cameras=state.previous.cameras)
    view = EngineContext(assembly=method.assembly, state=state, frame=frame, log=FrameLog(), change=change)
    return FitFixture(state.player.scene, view, Rng(method.assembly.recipe.seed))


def method_with(slot: str, part: Part) -> MethodUnderTest:
    """Return a dense method that has this part in its slot; its frames are encoded when they are asked for."""
    method = MethodUnderTest("dense")
    changed: dict[str, Any] = {slot: part}
    method.assembly = replace(method.assembly, **changed)
    return method


def effect(slot: str, part: Part) -> str:
    """Return in words what a part does to a tiny recording: no promise, but a part that spoils it is seen."""
    test = open_source(SOURCE).frame(FRAMES - 1, "test")
    quality, kilobytes = [], []
    for method in (method_with(slot, part), MethodUnderTest("dense")):
        steps = method.chain()
        image = render(steps[-1].state.player.gaussians, test.cameras, renderer=named_renderer("numpy"))
        quality.append(psnr(np.clip(image, 0, 1), test.images[0]))
        kilobytes.append(np.mean([len(step.packet.data) for step in steps[1:]]) / 1e3)
    pixels = f"{test.cameras.width} x {test.cameras.height} pixels"
    return (
        f"frame {FRAMES - 1} of a recording of {pixels}, with it and without: {quality[0]:.1f} / {quality[1]:.1f} dB "
        f"in the test camera, {kilobytes[0]:.1f} / {kilobytes[1]:.1f} KB a frame"
    )


def check_closed_loop(slot: str, part: Part) -> None:
    """Raise AssertionError unless a player reaches the encoder's state bit by bit, and a second run its bytes."""
    method = method_with(slot, part)
    first = method.chain()
    check_replay(method, first)
    for one, other in zip(first, method.chain(), strict=True):
        assert one.packet.data == other.packet.data, f"frame {one.packet.frame}: a second run writes other bytes"
