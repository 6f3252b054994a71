"""The packet of a frame, made to fit what it may take."""

from __future__ import annotations

from gsstream.core.changes import Delta, sent_rows
from gsstream.engine.budget.trim import Fitted, fit
from gsstream.engine.step.harden import rows_of
from gsstream.engine.step.problem import Problem, Solution
from gsstream.packet import EncodedPacket, PlayerState, encode_delta, encode_empty


def encode_frame(delta: Delta, before: PlayerState, problem: Problem, solution: Solution, trim: float) -> Fitted:
    """Return the delta and its packet, made to fit the frame's allowance of bytes, else less the share ``trim``.

    Arguments:
        delta: what the frame is to change. before: what players have before it.
        trim: share of the bytes to be given up where no size is asked for, 0 to 1.
    """
    packet = encode(delta, before, problem.frame)
    whole = Fitted(delta, packet, len(packet.data))
    budget = None if problem.allowance is None else problem.allowance.plan.max_bytes
    limit = budget or max(int((1 - trim) * whole.untrimmed), len(encode_empty(frame=problem.frame).data))
    if whole.untrimmed <= limit:
        return whole
    curvature = {}
    if delta.residual is not None:
        rows, sent = solution.rows.numpy(), sent_rows(before.layout, delta.residual.gates)
        curvature = {n: rows_of(solution.curvature[n].numpy(), rows, sent) for n in delta.residual.symbols}
    found = fit(delta, packet, curvature, before.layout, lambda some: encode(some, before, problem.frame), limit)
    # A share is no limit: of a packet that is mostly headers it would take everything, and the change with it.
    return whole if budget is None and found.delta.is_empty else found


def encode(delta: Delta, before: PlayerState, frame: int) -> EncodedPacket:
    """Return the packet of a delta; an empty one when nothing changes.

    Arguments:
        delta: what the frame changes.
        before: what players have before it.
        frame: its index.
    """
    if delta.is_empty:
        return encode_empty(frame=frame)
    return encode_delta(delta, before.layout, before.decoders, frame=frame)
