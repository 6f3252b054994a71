"""Motions leave room for the residual: a frame that may not take their bytes twice goes without them."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest

from gsstream.core.rng import Rng
from gsstream.engine.budget.epoch_scheduler import Allowance
from gsstream.engine.budget.plan import FramePlan
from gsstream.engine.step.active.change import detect_changed_tiles
from gsstream.engine.step.motion import Moved, propose_motion
from gsstream.engine.step.tools import RunTools
from gsstream.input.recordings.open import open_source
from gsstream.packet.changes.motion import encode_motions
from gsstream.parts.motion.constant_velocity import Coasting
from gsstream.testing.method_driver import SOURCE
from gsstream.testing.working import method_with


def within(max_bytes: int | None) -> Moved:
    parts = method_with("motion", Coasting(Coasting.Config(votes=0, share=0, displaced=0, asked=0))).parts
    state = method_with("motion", Coasting()).chain()[1].state
    frame = replace(open_source(SOURCE).frame(2), cameras=state.previous.cameras)
    plan = FramePlan(epochs=1, change_threshold=6.0, rd_lambda=0.0, max_bytes=max_bytes)
    change = detect_changed_tiles(state.previous, frame, 6.0)
    tools = RunTools(parts, Rng(0), Mock(), Mock(), budget=Allowance(plan, 0.0, float))
    return propose_motion(parts, state, frame, change, tools)


@pytest.mark.parametrize("spare", [0, -1])
def test_motions_take_half_of_a_frame_at_most(spare: int) -> None:
    free = within(None)
    assert sum(int(motion.moving.sum()) for motion in free.motions) > 0
    size = sum(len(data) for _, data in encode_motions(free.motions))
    held = within(2 * size + spare)
    assert len(held.motions) == (len(free.motions) if spare == 0 else 0)
    before = method_with("motion", Coasting()).chain()[1].state.player.gaussians.means
    went = (held.scene.gaussians.means != before).any()
    assert bool(went) == (spare == 0), "what is not sent is not moved either"
