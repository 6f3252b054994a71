"""The scene that a frame's residual starts from: that of the frame before, after the motions that the part proposes."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.core.changes import Delta, Field, Motion, Scene
from gsstream.core.changes.field import apply_field
from gsstream.core.changes.motion import apply_motions, union_rows
from gsstream.core.frame import Frame
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.stream_state import StreamState, updated
from gsstream.engine.step.compared import Found
from gsstream.engine.step.context import EngineContext
from gsstream.method.tools import Tools
from gsstream.packet.changes.field import encode_field
from gsstream.packet.changes.motion import encode_motions
from gsstream.parts.update.base import Scope

#: Largest share of the bytes a frame may take that its motions may take, where a residual follows them.
MAX_SIZE_SHARE = 0.5


class Moved(NamedTuple):
    """The motions that move anything, a field as the last, the scene after them, and the frame seen from that scene."""

    motions: tuple[Motion | Field, ...]
    scene: Scene
    work: EngineContext


def propose_motion(
    assembly: Assembly,
    state: StreamState,
    frame: Frame,
    found: Found,
    tools: Tools,
    images: FrameImages | None = None,
) -> Moved:
    """Ask the motion part, and apply what it proposes as every player will.

    Raises ComponentError when the part fails, or proposes motions that do not fit the scene or cannot be sent.
    """
    scene, budget = state.player.scene, tools.budget
    work = EngineContext(assembly, state, frame, tools.log, *found, part_scale=budget.part_scale, images=images)
    proposed = assembly.motion.propose(scene, work, tools.rng, state.motion_memory)
    motions = tuple(motion for motion in proposed if not motion.is_empty)
    if not motions:
        return Moved((), scene, work)
    with assembly.use("motion").errors():
        delta = Delta(motions)
        # What cannot be sent is refused before anything is learned on it.
        sections = encode_motions(delta.motions) + ([] if delta.field is None else encode_field(delta.field))
        share = 1.0 if assembly.update.scope(frame.index) is Scope.NONE else MAX_SIZE_SHARE
        if budget.max_bytes is not None and sum(len(data) for _, data in sections) > share * budget.max_bytes:
            return Moved((), scene, work)
        scene, touched = apply_motions(scene, delta.motions)
        if delta.field is not None:
            scene, rows = apply_field(scene, delta.field)
            touched = union_rows(len(scene.gaussians), touched, rows)
    gaussians = updated(work.gaussians, scene.gaussians, touched)
    # The session is handed on to the moved scene, with its caches of all that stands still. The old session stays
    # correct, as it must until the frame has succeeded: should it be used again, it fills its caches anew.
    if 2 * len(touched) > len(gaussians):
        return Moved(motions, scene, work.on(gaussians, None))
    session = work.session.commit(gaussians, torch.from_numpy(touched).to(gaussians.means.device))
    return Moved(motions, scene, work.on(gaussians, session))
