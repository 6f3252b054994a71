"""What the renderer keeps for the next frame."""

from __future__ import annotations

import torch

from gsstream.core.changes import Delta, Scene, sent_rows
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState
from gsstream.parts.render.base import RenderSession


def commit_session(view: EngineContext, scene: Scene, delta: Delta, player: PlayerState) -> RenderSession | None:
    """Return the session of the decoded scene, in which everything that did not change is still projected and sorted.

    None where keeping costs more than it saves: rows came or went, or most of them changed.
    """
    if delta.has_row_edit:
        return None
    if delta.is_empty and scene.gaussians is not player.gaussians:
        return None  # not even the motions were sent: the decoded scene is the one before them
    rows = sent_rows(scene.layout, delta.gates(scene.layout))
    if 2 * len(rows) > len(player.gaussians):
        return None
    device = view.gaussians.means.device
    gaussians = player.gaussians.map(lambda value: torch.from_numpy(value).to(device))
    return view.session.commit(gaussians, torch.from_numpy(rows).to(device))
