"""Two bodies before three cameras: frames of which the true motion is known, for the checks of motion parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.changes import Delta, Displacement, Layout, Scene, apply_delta
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.motion.base import MotionPart
from gsstream.testing.cases import flat, rig, scene
from gsstream.testing.method_driver import MethodUnderTest
from gsstream.testing.working import THRESHOLD, FitFixture

#: Index of the frame: another than that of the frame in ``testing.working``.
INDEX = 8
#: Number of pixels that a scene unit at the origin takes in a picture; all cameras look at the origin.
PIXELS = 20.0
CAMERAS = replace(
    rig(), width=96, height=48, Ks=np.tile(np.array([[3 * PIXELS, 0, 48], [0, 3 * PIXELS, 24], [0, 0, 1]]), (3, 1, 1))
)
#: Centres of the two bodies, scene units. The tiles of one lie neither in nor beside those of the other.
CENTRES = np.array([[-1.6, 0, 0], [1.6, 0, 0]])
#: Gaussians of each body; those of the first are stored first.
NUMBER = 40
ONE, TWO = slice(0, NUMBER), slice(NUMBER, 2 * NUMBER)


def two_bodies() -> Scene:
    """Return two clouds of small Gaussians of random colours, about six pixels wide."""
    drawn = np.random.default_rng(0).normal(0, 0.12, (2, NUMBER, 3)) + CENTRES[:, None]
    means = torch.from_numpy(drawn.reshape(-1, 3).astype(np.float32))
    gaussians = scene(means, scales=torch.full((2 * NUMBER, 3), -3.0)).map(torch.Tensor.numpy)
    return Scene(gaussians, Layout.flat(2 * NUMBER, 1.0))


def shifted(one: tuple[float, float, float], two: tuple[float, float, float]) -> FloatArray:
    """Return the displacement [2 NUMBER, 3] of all Gaussians, scene units, of bodies that move by so many pixels."""
    pixels: FloatArray = np.repeat(np.array([one, two], np.float32), NUMBER, axis=0)
    return pixels / np.float32(PIXELS)


def after_motion(part: MotionPart, before: Scene, shift: FloatArray, *, everywhere: bool = False) -> FloatArray:
    """Return the centres [2 NUMBER, 3] to which a part moves the bodies when pictures show them displaced by ``shift``.

    With ``everywhere`` all tiles count as changed, otherwise those in which the pictures differ.
    """
    work, rng = _work(before, shift, everywhere=everywhere)[1:]
    memory = part.follow(None, INDEX - 1, before.layout, Delta(), rng)
    found = Delta(tuple(motion for motion in part.propose(before, work, rng, memory) if not motion.is_empty))
    return apply_delta(before, found).gaussians.means


def invisible(before: Scene, shift: FloatArray) -> Scene:
    """Return bodies as black as what is behind them, which the last frame displaced by ``shift`` [N, 3].

    Pictures say nothing of where they are: the gradient of a loss by their places is exactly zero.
    """
    rows = np.arange(len(shift))
    moved = Displacement(rows, shift, np.zeros_like(shift))
    black = np.full_like(before.gaussians.sh0, -9.0)
    return replace(before, gaussians=replace(before.gaussians, sh0=black), displacement=moved)


def _work(before: Scene, shift: FloatArray, *, everywhere: bool) -> FitFixture:
    assembly = MethodUnderTest("dense").assembly
    number = len(shift)
    player = PlayerState(INDEX - 1, before, None, key_rows=number)  # type: ignore[arg-type]
    shape = (len(CAMERAS), CAMERAS.height, CAMERAS.width, 3)
    blank = Frame(INDEX, 0.0, np.zeros(shape, np.float32), CAMERAS)

    def context(previous: Frame, frame: Frame, change: Change | None) -> EngineContext:
        state = StreamState(player, flat(number), previous)
        return EngineContext(assembly=assembly, state=state, frame=frame, log=FrameLog(), change=change)

    def pictures(means: FloatArray) -> Frame:
        gaussians, camera = replace(before.gaussians, means=means).map(torch.from_numpy), context(blank, blank, None)
        images = [camera.shown(gaussians, view).numpy() for view in range(len(CAMERAS))]
        return replace(blank, images=np.stack(images))

    previous, frame = pictures(before.gaussians.means), pictures(before.gaussians.means + shift)
    shown, now = (FrameImages(each.images, torch.device("cpu")).all_stored() for each in (previous, frame))
    change = find_change(shown, now, THRESHOLD)
    if everywhere:
        change = Change(torch.ones_like(change.tiles), change.height, change.width)
    return FitFixture(before, context(previous, frame, change), Rng(assembly.recipe.seed))
