"""What every motion part promises, on a frame of 32 x 24 pixels and on one with two bodies."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.changes import Delta, Field, Motion, RowEdit, apply_delta
from gsstream.packet import decode_delta, encode_delta
from gsstream.parts.motion.base import MotionPart
from gsstream.testing.bodies import ONE, PIXELS, TWO, after_motion, invisible, shifted, two_bodies
from gsstream.testing.cases import fingerprint
from gsstream.testing.registry import check
from gsstream.testing.working import check_closed_loop, fit_fixture

#: Share of a body's motion that a part may leave to the residual after the passes that it makes by default: published
#: step sizes are for wider pictures, and no part is tuned to these. A part that looks at no gradient leaves all of it.
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
    before = invisible(two_bodies(), last)
    found = after_motion(part, before, last, everywhere=True) - before.gaussians.means
    off = float(np.abs(found - np.float32(share) * last).max() * PIXELS)
    assert off <= TOLERANCE, f"expected {share} of the last displacement to {TOLERANCE} pixels, got it {off:.2f} off"


@check("motion")
def check_motion_closed_loop(part: MotionPart) -> None:
    """A method with this part: a player reaches the encoder's state bit by bit, a second run writes the same bytes."""
    check_closed_loop("motion", part)
