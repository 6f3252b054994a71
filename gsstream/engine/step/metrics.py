"""Numbers of a frame: those that follow from its packet, for every method, and those of a step made of parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.changes import changing_rows, row_gates
from gsstream.core.log import FrameLog
from gsstream.engine.step.problem import Solution
from gsstream.packet import EncodedPacket, PacketKind, PlayerState
from gsstream.parts.render.session import RenderCache, RenderSession


def step_numbers(solution: Solution | None, candidates: int, session: RenderSession | None) -> dict[str, Any]:
    """Return what the optimisation did (None: there was none), and what the renderer keeps for the next frame."""
    numbers = {
        "dead_gates": 0 if solution is None else solution.dead_gates,
        "open_gates": [] if solution is None else list(solution.open_gates),
        "candidate_gaussians": candidates,
        "loss": 0.0 if solution is None else solution.loss,
        "iterations": 0 if solution is None else solution.iterations,
    }
    cache = RenderCache() if session is None else session.cache_bytes()
    if cache.per_view:
        numbers["cache"] = {
            "mb": cache.total / 1e6,
            "cameras": len(cache.per_view),
            "bytes_per_camera_and_gaussian": round(cache.per_camera_and_gaussian, 1),
        }
    return numbers


def log_packet(log: FrameLog, player: PlayerState, packet: EncodedPacket) -> None:
    """Log the sizes and counts that follow from a packet and the state it was decoded to.

    Where a key packet takes the place of a delta packet, only its sizes are logged: the counts stay those of the delta
    packet.
    """
    sizes = {
        "bytes": dict(packet.sizes),
        "num_gaussians": len(player.gaussians),
        "num_gates": len(player.layout.node_counts),
    }
    counts = _counts(player, packet)
    if packet.kind is PacketKind.KEY:
        counts = {name: log.numbers.get(name, count) for name, count in counts.items()}
    log.set(**sizes, **counts)


def _counts(player: PlayerState, packet: EncodedPacket) -> dict[str, int]:
    rows = sent = 0 if packet.kind is PacketKind.EMPTY else len(player.gaussians)
    added = gates = removed = moving = 0
    delta, before, displacement = player.delta, player.before, player.scene.displacement
    if packet.kind is PacketKind.DELTA and delta is not None and before is not None:
        added, removed = 0 if delta.added is None else len(delta.added), len(delta.removed)
        rows = added + (0 if delta.residual is None else changing_rows(delta.residual))
        sent = added + int((row_gates(before, delta) > 0).sum())
        gates = int((delta.gates(before) != 0).sum()) + added
        moving = sum(int(np.count_nonzero(motion.moving)) for motion in delta.motions)
    return {
        "changed_gaussians": rows,
        "sent_gaussians": sent,
        "active_gates": gates,
        "added_gaussians": added,
        "removed_gaussians": removed,
        "moving_groups": moving,
        "displaced_gaussians": 0 if displacement is None else len(displacement.rows),
    }
