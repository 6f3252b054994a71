"""What every motion part promises, on a frame of 32 x 24 pixels and on one with two bodies.

They are checked on two bodies before three cameras: frames of which the true motion is known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.changes import Delta, Displacement, Field, Layout, Motion, RowEdit, Scene, apply_delta
from gsstream.core.changes.scene import Groups
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState, decode_delta, encode_delta
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.motion.base import MotionPart
from gsstream.testing.cases import fingerprint, flat, rig, scene
from gsstream.testing.method_driver import THRESHOLD, FitFixture, MethodUnderTest, check_closed_loop, fit_fixture
from gsstream.testing.registry import check

#: Index of the frame with two bodies: another than that of the frame in ``testing.method_driver``.
BODIES_INDEX = 8
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


def after_motion(
    part: MotionPart, before: Scene, shift: FloatArray, *, everywhere: bool = False, memory: Any = None
) -> FloatArray:
    """Return the centres [2 NUMBER, 3] to which a part moves the bodies when pictures show them displaced by ``shift``.

    With ``everywhere`` all tiles count as changed, otherwise those in which the pictures differ. ``memory``: what the
    part kept across a key packet; None: it follows a delta packet.
    """
    work, rng = _work(before, shift, everywhere=everywhere)[1:]
    if memory is None:
        memory = part.follow(None, BODIES_INDEX - 1, before.layout, Delta(), rng)
    found = Delta(tuple(motion for motion in part.propose(before, work, rng, memory) if not motion.is_empty))
    return apply_delta(before, found).gaussians.means


def invisible(before: Scene, shift: FloatArray) -> Scene:
    """Return black bodies before a black background, which the last frame displaced by ``shift`` [N, 3].

    Pictures do not show where these Gaussians are: the gradient of a loss by their places is exactly zero.
    """
    rows = np.arange(len(shift))
    moved = Displacement(rows, shift, np.zeros_like(shift))
    black = np.full_like(before.gaussians.sh0, -9.0)
    return replace(before, gaussians=replace(before.gaussians, sh0=black), displacement=moved)


def _work(before: Scene, shift: FloatArray, *, everywhere: bool) -> FitFixture:
    assembly = MethodUnderTest("dense").assembly
    number = len(shift)
    player = PlayerState(BODIES_INDEX - 1, before, None, key_rows=number)  # type: ignore[arg-type]
    shape = (len(CAMERAS), CAMERAS.height, CAMERAS.width, 3)
    blank = Frame(BODIES_INDEX, 0.0, np.zeros(shape, np.float32), CAMERAS)

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


#: Share of a body's motion that a part may leave to the residual after the passes that it makes by default: published
#: step sizes are for wider pictures, and no part is tuned to these. A part that looks at no gradient leaves the whole
#: motion unfound.
MOST_LEFT = 0.75
#: Pixels by which a motion may differ from the share of the last frame's motion that it begins with: half a
#: quantisation step of 0.1, and the error of motions that anchors average.
TOLERANCE = 0.25


def _proposed(part: MotionPart, *, changed: bool = True) -> tuple[Motion | Field, ...]:
    case = fit_fixture(changed=changed)
    motions = part.propose(case.scene, case.work, case.rng)
    assert isinstance(motions, tuple), f"propose(): expected a tuple of Motion, got {type(motions).__name__}"
    for motion in motions:
        assert isinstance(motion, Motion | Field), f"propose(): expected Motion or Field, got {type(motion).__name__}"
    return motions


@check("motion")
def check_motion_fits(part: MotionPart) -> None:
    """A proposal fits the scene, leads to finite values, and is the same motion after it was encoded and decoded."""
    scene = fit_fixture().scene
    sent = Delta(tuple(motion for motion in _proposed(part) if not motion.is_empty))
    if sent.is_empty:
        return
    read = decode_delta(encode_delta(sent, scene.layout, {}, frame=1).data, scene, {})
    for motion, got in zip(sent.changes, read.changes, strict=True):
        assert fingerprint(motion) == fingerprint(got), f"expected {motion!r}, a player reads {got!r}"
    after = apply_delta(scene, read).gaussians
    for name in ("means", "quats"):
        bad = int((~np.isfinite(getattr(after, name))).any(1).sum())
        assert bad == 0, f"{name}: expected finite values, got {bad} rows that are not"


@check("motion")
def check_motion_follow(part: MotionPart) -> None:
    """The memory of a part follows from the packets: a part made anew remembers the same, and no argument is changed.

    A frame is proposed from what is remembered, after rows have left as well.
    """
    case = fit_fixture()
    rows = RowEdit(removed=np.arange(0, len(case.scene.gaussians), 3))
    memory, scene = None, case.scene
    for frame, delta in ((1, Delta()), (2, Delta().with_row_edit(rows)), (3, Delta())):
        before = fingerprint(memory)
        after = part.follow(memory, frame, scene.layout, delta, case.rng)
        again = type(part)(part.config).follow(memory, frame, scene.layout, delta, case.rng)
        assert fingerprint(after) == fingerprint(again), f"frame {frame}: two calls remember different things"
        assert fingerprint(memory) == before, f"frame {frame}: what was remembered before was changed"
        memory, scene = after, apply_delta(scene, delta)
    part.propose(scene, case.work.on(scene.gaussians.map(torch.from_numpy)), case.rng, memory)


@check("motion")
def check_motion_across_key(part: MotionPart) -> None:
    """What a part keeps across a key packet follows from two scenes, neither is changed, and a frame is proposed."""
    case = fit_fixture()
    order = np.random.default_rng(0).permutation(len(case.scene.gaussians))
    moved = np.full((len(order), 3), 0.02, np.float32)
    groups = Groups(0.5, 2, np.zeros(len(order), np.int32), 1)
    replaced = replace(case.scene, displacement=Displacement(np.arange(len(order)), moved, 0 * moved), groups=groups)
    key = Scene(case.scene.gaussians.rows(order), Layout.flat(len(order), 1.0))
    before = fingerprint((replaced, key))
    memory = part.across_key(replaced, key)
    again = type(part)(part.config).across_key(replaced, key)
    assert fingerprint(memory) == fingerprint(again), "two calls keep different things"
    assert fingerprint((replaced, key)) == before, "a scene was changed"
    part.propose(key, case.work.on(key.gaussians.map(torch.from_numpy)), case.rng, memory)


@check("motion")
def check_motion_pure(part: MotionPart) -> None:
    """The scene stays as it was, and the same frame gives the same motions again."""
    case = fit_fixture()
    before = fingerprint((case.scene.gaussians, case.scene.layout, case.scene.displacement))
    first = part.propose(case.scene, case.work, case.rng)
    after = fingerprint((case.scene.gaussians, case.scene.layout, case.scene.displacement))
    assert after == before, "the scene was changed"
    assert fingerprint(first) == fingerprint(_proposed(part)), "the second call gives other motions than the first"


@check("motion")
def check_motion_static_frame(part: MotionPart) -> None:
    """Where no tile of any view changed, no group moves: a velocity dies when its body stops."""
    for motion in _proposed(part, changed=False):
        assert motion.is_empty, f"nothing changed: expected that nothing moves, got {motion!r}"


@check("motion")
def check_motion_leaves_unchanged(part: MotionPart) -> None:
    """Where one body moves and no tile near another changes, the other stays where it is, bit by bit."""
    before = two_bodies()
    after = after_motion(part, before, shifted((1.2, -0.6, 0.3), (0, 0, 0)))
    moved = int((after[TWO] != before.gaussians.means[TWO]).any(1).sum())
    assert moved == 0, f"expected that no Gaussian of the body that stood still moves, got {moved}"


@check("motion", trait="finds_motion")
def check_motion_finds_bodies(part: MotionPart) -> None:
    """Two bodies that move by a pixel or two in different directions are both found: most of each motion is made."""
    before, wanted = two_bodies(), shifted((1.2, -0.6, 0.3), (-0.8, 1.0, -0.3))
    missed = after_motion(part, before, wanted) - before.gaussians.means - wanted
    for name, rows in (("first", ONE), ("second", TWO)):
        left = float(np.abs(missed[rows]).mean() / np.abs(wanted[rows]).mean())
        assert left <= MOST_LEFT, f"{name} body: expected at most {MOST_LEFT} of its motion to be left, got {left:.2f}"


@check("motion", trait="momentum")
def check_motion_momentum(part: MotionPart) -> None:
    """A body of which the images show no gradient moves by the claimed share of its last displacement."""
    share, last = part.claims().momentum, shifted((1.5, 0.8, 0), (-1.0, 0.7, 0))
    assert share is not None
    off = momentum_error(part, invisible(two_bodies(), last), last)
    assert off <= TOLERANCE, f"expected {share} of the last displacement to {TOLERANCE} pixels, got it {off:.2f} off"


def momentum_error(part: MotionPart, before: Scene, way: FloatArray) -> float:
    """Return how many pixels at most bodies that no image shows are off the claimed share of ``way`` [N, 3]."""
    found = after_motion(part, before, way, everywhere=True) - before.gaussians.means
    return float(np.abs(found - np.float32(part.claims().momentum) * way).max() * PIXELS)


@check("motion")
def check_motion_closed_loop(part: MotionPart) -> None:
    """A method with this part: a player reaches the encoder's state bit by bit, a second run writes the same bytes."""
    check_closed_loop("motion", part)
