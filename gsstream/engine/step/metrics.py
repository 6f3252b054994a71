"""Numbers of one frame step that need no rendering."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.changes import Delta, changing_rows
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.problem import Solution
from gsstream.packet import EncodedPacket
from gsstream.render.base import RenderCache, RenderSession


def step_metrics(
    delta: Delta, after: StreamState, packet: EncodedPacket, solution: Solution | None, candidates: int
) -> dict[str, Any]:
    """Return the numbers of a frame.

    Arguments:
        delta: what was sent.
        after: the state after the frame.
        packet: that holds it.
        solution: what the optimisation found; None in a frame without one.
        candidates: Gaussians that took part.
    """
    before = after.player.before or after.player.layout
    gates = delta.gates(before)
    return {
        "bytes": dict(packet.sizes),
        "active_gaussians": 0 if delta.residual is None else changing_rows(delta.residual),
        "sent_gaussians": int(np.asarray(before.node_counts)[gates != 0].sum()),
        "num_gaussians": len(after.player.gaussians),
        "active_gates": int((gates != 0).sum()),
        "num_gates": len(gates),
        "moving_groups": sum(int(np.count_nonzero(motion.moving)) for motion in delta.motions),
        "displaced_gaussians": 0 if after.player.scene.moved is None else len(after.player.scene.moved.rows),
        "dead_gates": 0 if solution is None else solution.dead_gates,
        "births": 0 if delta.births is None else len(delta.births),
        "deaths": len(delta.deaths),
        "candidate_gaussians": candidates,
        "loss": 0.0 if solution is None else solution.loss,
        "iterations": 0 if solution is None else solution.iterations,
    }


def cache_metrics(session: RenderSession | None) -> dict[str, Any]:
    """Return what the renderer keeps from frame to frame; nothing where it keeps nothing."""
    cache = RenderCache() if session is None else session.cache_bytes()
    if not cache.per_view:
        return {}
    per_pair = round(cache.per_camera_and_gaussian, 1)
    known = {"mb": cache.total / 1e6, "cameras": len(cache.per_view), "bytes_per_camera_and_gaussian": per_pair}
    return {"cache": known}
