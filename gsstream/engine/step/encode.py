"""The packet of a frame, made to fit what it may take."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gsstream.core.changes import Delta, sent_rows
from gsstream.engine.budget.trim import Fitted, fit
from gsstream.engine.step.harden import rows_of
from gsstream.engine.step.problem import Solution
from gsstream.method.packets import delta_packet
from gsstream.packet import EncodedPacket, PlayerState
from gsstream.packet.changes.motion import encode_motions


def encode_frame(
    delta: Delta, before: PlayerState, frame: int, solution: Solution, trim: float, budget: int | None = None
) -> Fitted:
    """Return the delta and its packet, made to fit ``budget``, else less the share ``trim``.

    Arguments:
        delta: what the frame is to change. before: what players have before it.
        frame: index of the frame.
        solution: what the optimisation found.
        trim: share of the bytes to be given up where no size is asked for, 0 to 1.
        budget: bytes that the frame may take; None: no limit.
    """
    # Packets of the same motions are made several times, and motions are never trimmed.
    motions = delta.motions
    encoded = partial(delta_packet, before, frame=frame, known=(motions, encode_motions(motions)))
    packet = encoded(delta)
    whole = Fitted(delta, packet, len(packet.data))
    limit = budget or _share(delta, encoded, whole.untrimmed, trim)
    if whole.untrimmed <= limit:
        return whole
    curvature = {}
    if delta.residual is not None:
        rows, sent = solution.rows.numpy(), sent_rows(before.layout, delta.residual.gates)
        curvature = {n: rows_of(solution.curvature[n].numpy(), rows, sent) for n in delta.residual.symbols}
    found = fit(delta, packet, curvature, before.layout, encoded, limit)
    # Where only a share is asked for, a packet is not trimmed to nothing: one that is mostly headers would lose all of
    # its change for a few bytes.
    lost = found.delta.is_empty or found.delta.edits_rows != delta.edits_rows
    return whole if budget is None and lost else found


def _share(delta: Delta, encoded: Callable[[Delta], EncodedPacket], size: int, trim: float) -> int:
    """Bytes left of ``size`` when the residual gives up the share ``trim``; motions and births give up nothing."""
    others = delta.with_residual(None)
    fixed = 0 if others.is_empty else len(encoded(others).data)
    return max(fixed + int((1 - trim) * (size - fixed)), len(encoded(Delta()).data))
