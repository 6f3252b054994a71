"""The packet of a frame, made to fit what it may take."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gsstream.core.changes import Delta, sent_rows
from gsstream.engine.budget.trim import TrimmedDelta, trim_to_size
from gsstream.engine.step.problem import Solution
from gsstream.engine.step.quantise import gather_rows_or_zero
from gsstream.method.packets import delta_packet
from gsstream.packet import EncodedPacket, PlayerState
from gsstream.packet.changes.motion import encode_motions


def encode_frame(
    delta: Delta, before: PlayerState, frame: int, solution: Solution, trim: float, budget: int | None = None
) -> TrimmedDelta:
    """Return the delta and its packet, made to fit ``budget``, else less the share ``trim``."""
    # Packets of the same motions are made several times, and motions are never trimmed.
    motions = delta.motions
    encoded = partial(delta_packet, before, frame=frame, known=(motions, encode_motions(motions)))
    packet = encoded(delta)
    whole = TrimmedDelta(delta, packet, len(packet.data))
    limit = budget or _share(delta, encoded, whole.untrimmed, trim)
    if whole.untrimmed <= limit:
        return whole
    curvature = {}
    if delta.residual is not None:
        rows, sent = solution.rows.numpy(), sent_rows(before.layout, delta.residual.gates)
        curvature = {n: gather_rows_or_zero(solution.curvature[n].numpy(), rows, sent) for n in delta.residual.symbols}
    found = trim_to_size(delta, packet, curvature, before.layout, encoded, limit)
    # Where only a share is asked for, a packet is not trimmed to nothing: one that is mostly headers would lose all of
    # its change for a few bytes.
    lost = found.delta.is_empty or found.delta.has_row_edit != delta.has_row_edit
    return whole if budget is None and lost else found


def _share(delta: Delta, encoded: Callable[[Delta], EncodedPacket], size: int, trim: float) -> int:
    """Bytes left of ``size`` when the share ``trim`` is cut from the residual; only the residual is cut."""
    others = delta.with_residual(None)
    fixed = 0 if others.is_empty else len(encoded(others).data)
    return max(fixed + int((1 - trim) * (size - fixed)), len(encoded(Delta()).data))
