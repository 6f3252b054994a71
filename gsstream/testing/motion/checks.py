"""What every motion part promises, on a frame of 32 x 24 pixels."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Motion, apply_motion
from gsstream.packet.base import Section
from gsstream.packet.changes.motion import decode_motions, encode_motions
from gsstream.parts.motion.base import MotionPart
from gsstream.testing.cases import fingerprint
from gsstream.testing.registry import check
from gsstream.testing.working import check_closed_loop, fit_fixture


def _proposed(part: MotionPart, *, changed: bool = True) -> tuple[Motion, ...]:
    case = fit_fixture(changed=changed)
    motions = part.propose(case.scene, case.work, case.rng)
    assert isinstance(motions, tuple), f"propose(): expected a tuple of Motion, got {type(motions).__name__}"
    for motion in motions:
        assert isinstance(motion, Motion), f"propose(): expected Motion, got {type(motion).__name__}"
    return motions


@check("motion")
def check_motion_fits(part: MotionPart) -> None:
    """What is proposed fits the scene, leads to finite values, and is the same motion when a player has read it."""
    scene, motions = fit_fixture().scene, tuple(motion for motion in _proposed(part) if not motion.is_empty)
    sent = encode_motions(motions)
    got = decode_motions(Section(sent[0][1], 0), scene) if sent else ()
    for motion, read in zip(motions, got, strict=True):
        assert fingerprint(motion) == fingerprint(read), f"expected {motion!r}, a player reads {read!r}"
        scene, rows = apply_motion(scene, motion)
        for name in ("means", "quats"):
            bad = int((~np.isfinite(getattr(scene.gaussians, name)[rows])).sum())
            assert bad == 0, f"{name}: expected finite values, got {bad} that are not"


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
        moving = int(np.count_nonzero(motion.moving))
        assert moving == 0, f"nothing changed: expected no moving group, got {moving} of {len(motion.moving)}"


@check("motion")
def check_motion_closed_loop(part: MotionPart) -> None:
    """A method with this part: a player reaches the encoder's state bit by bit, a second run writes the same bytes."""
    check_closed_loop("motion", part)
