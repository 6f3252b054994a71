"""From what was learned to what is sent: deterministic gates and integer symbols."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch

from gsstream.core.changes import Delta, Residual, sent_rows
from gsstream.core.shapes import IntArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import VARIABLE
from gsstream.engine.budget.trim import TrimmedDelta, trim_to_size
from gsstream.engine.step.problem import Problem, Solution
from gsstream.method.packets import delta_packet
from gsstream.packet import EncodedPacket, PlayerState, quantise_decoders
from gsstream.packet.changes.motion import encode_motions
from gsstream.parts.residual.layout import AttributeCode
from gsstream.parts.update.base import quantise_latents as residual_symbols

#: Largest symbol of 32 bits that float32 represents: anything between it and 2^31 would be rounded up to 2^31.
MAX_INT32_SYMBOL = 2.0**31 - 256


def quantise_residual(assembly: Assembly, problem: Problem, solution: Solution) -> Residual | None:
    """Return the transmitted integers; None when nothing changes. A gate that opens for zeros alone is closed.

    Raises ComponentError when what was learned cannot be sent: not finite, or beyond symbols of 32 bits.
    """
    codes, layout = problem.codes, problem.layout
    check_solution(assembly, codes, solution)
    gates = torch.round(assembly.gate.sample(solution.logits, None) * assembly.gate.num_levels).numpy().astype(np.uint8)
    rows = solution.rows.numpy()
    integers = {name: value.numpy() for name, value in residual_symbols(codes, solution.latents).items()}
    changing = np.zeros(len(rows), bool)
    for value in integers.values():
        changing |= value.any(1)
    touched = np.zeros(len(gates), bool)
    touched[layout.node_of[rows[changing]]] = True
    gates = np.where(touched, gates, 0).astype(np.uint8)
    if not gates.any():
        return None
    sent = np.flatnonzero(np.repeat(gates != 0, layout.node_counts))
    table = {name: gather_rows_or_zero(value, rows, sent) for name, value in integers.items()}
    table = {name: value for name, value in table.items() if value.any()}
    decoders = {name: value.numpy() for name, value in solution.decoders.items() if name in table}
    steps = {name: codes[name].step for name in table}
    return Residual(
        gates=gates,
        num_levels=assembly.gate.num_levels,
        symbols=table,
        steps=steps,
        decoders=quantise_decoders(decoders),
    )


def check_solution(assembly: Assembly, codes: Mapping[str, AttributeCode], solution: Solution) -> None:
    """Raise ComponentError unless what was learned can be sent: finite, and residuals within 32 bit symbols."""
    use = assembly.use("update")
    for name, value in solution.latents.items():
        most = codes[name].step * MAX_INT32_SYMBOL
        what = f"{name} after the last iteration ({VARIABLE}=step finds the first)"
        use.values(what, value, limits=(-most, most), rows=solution.rows)
    for name, value in solution.decoders.items():
        use.values(f"decoder of {name}", value)


def gather_rows_or_zero(values: np.ndarray[Any, Any], known: IntArray, wanted: IntArray) -> np.ndarray[Any, Any]:
    """Return the wanted rows of a table; rows that it does not know are zero.

    Arguments:
        values: [K, L] the table.
        known: [K] int64 rows that it has, ascending.
        wanted: [W] int64 rows, ascending.
    """
    out = np.zeros((len(wanted), values.shape[1]), values.dtype)
    place = np.searchsorted(known, wanted)
    inside = (place < len(known)) & (known[np.minimum(place, max(0, len(known) - 1))] == wanted)
    out[inside] = values[place[inside]]
    return out


def encode_frame(
    delta: Delta, before: PlayerState, frame: int, solution: Solution, trim: float, max_bytes: int | None = None
) -> TrimmedDelta:
    """Return the delta and its packet, made to fit ``max_bytes``, else less the share ``trim``."""
    # Packets of the same motions are made several times, and motions are never trimmed.
    motions = delta.motions
    encoded = partial(delta_packet, before, frame=frame, known=(motions, encode_motions(motions)))
    packet = encoded(delta)
    whole = TrimmedDelta(delta, packet, delta, len(packet.data), before.layout)
    if max_bytes is None and trim == 0:
        return whole
    limit = max_bytes or _share(delta, encoded, whole.untrimmed, trim)
    if whole.untrimmed <= limit:
        return whole
    curvature = {}
    if delta.residual is not None:
        rows, sent = solution.rows.numpy(), sent_rows(before.layout, delta.residual.gates)
        curvature = {n: gather_rows_or_zero(solution.curvature[n].numpy(), rows, sent) for n in delta.residual.symbols}
    found = trim_to_size(delta, packet, curvature, layout=before.layout, encode=encoded, max_bytes=limit)
    # Where only a share is asked for, a packet is not trimmed to nothing: one that is mostly headers would lose all of
    # its change for a few bytes.
    lost = found.delta.is_light_at_most or found.delta.has_row_edit != delta.has_row_edit
    return whole if max_bytes is None and lost else found


def _share(delta: Delta, encoded: Callable[[Delta], EncodedPacket], size: int, trim: float) -> int:
    """Bytes left of ``size`` when the share ``trim`` is cut from the residual; only the residual is cut."""
    others = delta.with_residual(None)
    fixed = 0 if others.is_empty else len(encoded(others).data)
    return max(fixed + int((1 - trim) * (size - fixed)), len(encoded(Delta()).data))
