"""What the renderer keeps for the next frame."""

from __future__ import annotations

import torch

from gsstream.core.changes import Delta, Scene, sent_rows
from gsstream.core.gaussians import Gaussians
from gsstream.engine.state.stream_state import Resident, updated
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState
from gsstream.parts.render.base import RenderSession

#: Share of the rows that a frame may change where what the renderer keeps of the others pays.
MOST_CHANGED = 0.5


def keep(
    view: EngineContext, scene: Scene, delta: Delta, player: PlayerState
) -> tuple[RenderSession | None, Resident | None]:
    """Return what of a frame stays with the renderer, and on its device; nothing where :func:`commit_session` says so.

    Where the frame changed nothing, the images that the scene shows stay those of the frame before.
    """
    found = commit_session(view, scene, delta, player)
    if found is None:
        return None, None
    if view.images.device.type == "cpu":
        return found[0], None
    return found[0], Resident(found[1], view.hierarchy, view.previous_images if delta.is_empty else view.images)


def commit_session(
    view: EngineContext, scene: Scene, delta: Delta, player: PlayerState
) -> tuple[RenderSession, Gaussians[torch.Tensor]] | None:
    """Return the session of the decoded scene, with what did not change still projected, and the scene itself.

    None where keeping costs more than it saves: rows came or went, or most of them changed.
    """
    if delta.has_row_edit:
        return None
    if delta.is_empty and scene.gaussians is not player.gaussians:
        return None  # not even the motions were sent: the decoded scene is the one before them
    rows = sent_rows(scene.layout, delta.gates(scene.layout))
    if len(rows) > MOST_CHANGED * len(player.gaussians):
        return None
    gaussians = updated(view.gaussians, player.gaussians, rows)
    return view.session.commit(gaussians, torch.from_numpy(rows).to(gaussians.means.device)), gaussians
