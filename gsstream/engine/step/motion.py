"""The scene that a frame's residual starts from: that of the frame before, after the motions that the part proposes."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.core.changes import Motion, Scene
from gsstream.core.changes.motion import apply_motions
from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.guard import error_context
from gsstream.engine.budget.epoch_scheduler import Allowance
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.active.change import Change
from gsstream.engine.step.context import EngineContext
from gsstream.packet.changes.motion import encode_motions

#: Largest share of the bytes a frame may take that its motions may take.
MAX_SIZE_SHARE = 0.5


class Moved(NamedTuple):
    """The motions that move anything, the scene after them, and the frame seen from that scene."""

    motions: tuple[Motion, ...]
    scene: Scene
    view: EngineContext


def propose_motion(
    parts: Assembly, state: StreamState, frame: Frame, change: Change | None, rng: Rng,
    allowance: Allowance | None = None,
) -> Moved:  # fmt: skip
    """Ask the motion part, and apply what it proposes as every player will.

    Raises ComponentError when the part fails, or proposes motions that do not fit the scene or cannot be sent.
    """
    scene = state.player.scene
    view = EngineContext(
        parts, state.gaussians, state.hierarchy, frame, state.previous, state.exposure, change, state.session,
    )  # fmt: skip
    motions = tuple(motion for motion in parts.motion.propose(scene, view, rng) if not motion.is_empty)
    if not motions:
        return Moved((), scene, view)
    with error_context("motion", parts.part("motion"), parts.where):
        sections = encode_motions(motions)  # what cannot be sent is refused before anything is learned on it
        most = None if allowance is None else allowance.plan.max_bytes
        if most is not None and sum(len(data) for _, data in sections) > MAX_SIZE_SHARE * most:
            return Moved((), scene, view)
        scene, touched = apply_motions(scene, motions)
    gaussians = scene.gaussians.map(torch.from_numpy)
    # The session is handed on to the moved scene, with its caches of all that stands still. The old session stays
    # correct, as it must until the frame has succeeded: should it be used again, it fills its caches anew.
    session = view.session.commit(gaussians, torch.from_numpy(touched)) if 2 * len(touched) <= len(gaussians) else None
    return Moved(motions, scene, view.on(gaussians, session))
