"""One frame, top to bottom: (StreamState, Frame) -> Step.

context -> estimate -> propagate -> init gates -> optimise -> harden -> encode -> decode own packet -> next state
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.delta import Delta
from gsstream.core.delta import active_rows as changed_rows
from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.core.shapes import IntArray
from gsstream.core.state import GateState
from gsstream.core.storage import packed
from gsstream.engine.step.active.change import detect_change
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.controller import planned
from gsstream.engine.budget.pace import Allowance
from gsstream.engine.budget.spent import spent
from gsstream.engine.budget.trim import Fitted, fit
from gsstream.engine.assembly.checks import UNIT, VARIABLE, Checks, check_output, check_values
from gsstream.engine.step.context import StepContext
from gsstream.engine.assembly.guard import guarded
from gsstream.engine.step.insertion import with_insertions
from gsstream.engine.step.optimise import optimise
from gsstream.engine.step.problem import Problem, Solution
from gsstream.engine.state.rows import follow
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.packet import EncodedPacket, PlayerState, decode_packet, encode_delta, encode_empty, quantise_decoders
from gsstream.render.base import RenderCache, RenderSession
from gsstream.residual.base import coarser
from gsstream.residual.base import symbols as residual_symbols

#: Largest symbol a residual may have; float32 rounds what lies between it and 2^31 up.
MOST_SYMBOL = 2.0**31 - 256


def frame_step(
    parts: Assembly, state: StreamState, frame: Frame, rng: Rng, allowance: Allowance | None = None
) -> Step:
    """Advance the stream by one frame. Pure: a failure leaves ``state`` as it was.

    Arguments:
        allowance: what the frame may spend; None: what the recipe says.

    Raises ComponentError when a part fails, unless the recipe says ``stream.on_error: repeat``: then the frame changes
    nothing, and its metrics and a warning say why.
    """
    started = time.perf_counter()
    try:
        return _step(parts, state, frame, rng, allowance)
    except (ComponentError, ShapeError) as error:
        if parts.recipe.stream.on_error == "raise":
            raise
        warnings.warn(f"frame {frame.index} repeats the one before it: {error}", RepeatedFrameWarning, stacklevel=2)
        step = still_step(state, frame, time.perf_counter() - started)
        return replace(step, metrics={**step.metrics, "error": str(error)})


class RepeatedFrameWarning(UserWarning):
    """A part failed, and its frame was sent as "nothing changed"."""


def _step(parts: Assembly, state: StreamState, frame: Frame, rng: Rng, allowance: Allowance | None) -> Step:
    clock, own = [time.perf_counter()], parts.recipe.stream
    if allowance is not None:
        parts = planned(parts, allowance.plan)
    if frame.effort == 0:
        return still_step(state, frame, 0.0)
    change = detect_change(state.previous, frame, parts.recipe.stream.change_threshold)
    if change is not None and change.share == 0:
        return still_step(state, frame, time.perf_counter() - clock[0])
    with guarded("renderer", parts.renderer, frame.index):
        context = StepContext(state, frame, parts.renderer, parts.recipe.background, change)
    gate, active = suspects(parts, state, context)
    clock.append(time.perf_counter())

    session, base = context.session_for(active), context.gaussians.rows(active)
    problem = Problem(state, frame, active, base, gate, session, allowance)
    began = allowance.clock() if allowance else 0.0
    solution = optimise(parts, problem, rng.stream("frame", frame.index))
    optimised = allowance.clock() - began if allowance else 0.0
    check_solution(parts, problem, solution)
    clock.append(time.perf_counter())

    delta = with_insertions(parts, state, frame, harden(parts, problem, solution), rng)
    fitted = within(problem, solution, delta, parts.recipe.codec.trim)
    delta, packet = fitted.delta, fitted.packet
    player = decode_packet(state.player, packet.data)
    clock.append(time.perf_counter())
    with guarded("renderer", parts.renderer, frame.index):
        kept = committed(context.session, state, delta, player)
    clock.append(time.perf_counter())
    # A frame that changed nothing is not what the scene shows: the next one is compared with the last that did, so that
    # a change too slow to see from frame to frame adds up until it is seen.
    images = packed(frame.images, parts.recipe.data.images)
    shown = state.previous if delta.is_empty else replace(frame, images=images)
    after = follow(replace(state, previous=shown, gate_moments=solution.gate_moments, session=kept), player)
    metrics = step_metrics(delta, after, packet, solution, active)
    metrics["changed_tiles"] = 1.0 if change is None else change.share
    metrics["seconds"] = dict(zip(("confidence", "optimise", "code", "keep"), np.diff(clock).tolist(), strict=True))
    if allowance is not None and solution.pace is not None:
        metrics["budget"] = spent(
            allowance, solution.pace, fitted, own, epochs=solution.iterations / len(frame.cameras),
            before=began - allowance.started, optimise=optimised,
        )  # fmt: skip
    return Step(after, packet, "empty" if delta.is_empty else "delta", metrics)


def within(problem: Problem, solution: Solution, delta: Delta, trim: float) -> Fitted:
    """The delta and its packet, made to fit the frame's allowance of bytes, else less the share ``trim``."""
    state, index, allowance = problem.state, problem.frame.index, problem.allowance
    packet = encode(delta, state, index)
    whole = Fitted(delta, packet, len(packet.data))
    budget = None if allowance is None else allowance.plan.max_bytes
    limit = budget or max(int((1 - trim) * whole.untrimmed), len(encode_empty(frame=index).data))
    if whole.untrimmed <= limit:
        return whole
    layout, active = state.player.layout, solution.active.numpy()
    sent = changed_rows(layout, delta.gates)
    curvature = {n: _rows_of(solution.curvature[n].numpy(), active, sent) for n in delta.symbols}
    found = fit(delta, packet, curvature, layout, lambda some: encode(some, state, index), limit)
    # A share is no limit: of a packet that is mostly headers it would take everything, and the change with it.
    return whole if budget is None and found.delta.is_empty else found


def committed(session: RenderSession, state: StreamState, delta: Delta, player: PlayerState) -> RenderSession | None:
    """The session of the decoded scene, in which everything that did not change is still projected and sorted.

    None where keeping costs more than it saves: rows came or went, or most of them changed.
    """
    rows = changed_rows(state.player.layout, delta.gates)
    if delta.edits_rows or 2 * len(rows) > len(state.gaussians):
        return None
    return session.commit(player.gaussians.map(torch.from_numpy), torch.from_numpy(rows))


def still_step(state: StreamState, frame: Frame, seconds: float) -> Step:
    """A frame in which no tile of any view changed, or that is skipped: an empty packet, and no part is asked."""
    started = time.perf_counter()
    packet = encode_empty(frame=frame.index)
    after = replace(state, player=decode_packet(state.player, packet.data))
    gates = np.zeros(len(state.player.layout.node_counts), np.uint8)
    solution = Solution(torch.zeros(0), {}, {}, GateState(torch.zeros(0)), {}, 0.0, 0)
    metrics = step_metrics(Delta(gates, 1), after, packet, solution, torch.zeros(0))
    metrics["changed_tiles"] = 0.0
    metrics["seconds"] = {"confidence": seconds, "optimise": 0.0, "code": time.perf_counter() - started, "keep": 0.0}
    return Step(after, packet, "empty", metrics)


def suspects(parts: Assembly, state: StreamState, context: StepContext) -> tuple[GateState, torch.Tensor]:
    """Initial gates [M], and the rows [A] that may change: suspect to the cameras and behind a gate that may open.

    What each part returns is looked at before the next one gets it.
    """
    index, nodes, level = context.index, state.hierarchy.num_nodes, parts.checks
    with guarded("confidence", parts.confidence, index):
        logits = parts.confidence.estimate(context)
    check_output(level, "confidence", parts.confidence, index, "estimate()", logits, (state.hierarchy.num_gaussians,))
    with guarded("propagation", parts.propagation, index):
        node_logits = parts.propagation.propagate(logits, state.hierarchy)
    check_output(level, "propagation", parts.propagation, index, "propagate()", node_logits, (nodes,))
    with guarded("gate", parts.gate, index):
        gate = parts.gate.init(node_logits)
        probability = parts.gate.open_probability(gate)
    check_output(level, "gate", parts.gate, index, "init().logits", gate.logits, (nodes,))
    check_output(level, "gate", parts.gate, index, "open_probability()", probability, (nodes,), UNIT)
    may_open = probability > parts.recipe.stream.active_threshold
    rows = may_open[state.hierarchy.node_of] & context.suspects(parts.recipe.stream.change_votes)
    return gate, rows.nonzero()[:, 0]


def check_solution(parts: Assembly, problem: Problem, solution: Solution) -> None:
    """Raise ComponentError unless what was learned can be sent: finite, and residuals within 32 bit symbols."""
    if parts.checks is Checks.OFF:
        return
    codes, frame = coarser(parts.update.codes(), problem.step_scale), problem.frame.index
    for name, value in solution.latents.items():
        most = codes[name].step * MOST_SYMBOL
        what = f"{name} after the last iteration ({VARIABLE}=step finds the first)"
        check_values("update", parts.update, what, value, frame, limits=(-most, most), rows=solution.active)
    for name, value in solution.decoders.items():
        check_values("update", parts.update, f"decoder of {name}", value, frame)


def harden(parts: Assembly, problem: Problem, solution: Solution) -> Delta:
    """The transmitted integers: deterministic gates and the symbols of the rows behind them.

    A gate behind which every symbol is zero is closed: it would cost bits and change nothing (ours).
    """
    layout = problem.state.player.layout
    frame = problem.frame.index
    with guarded("gate", parts.gate, frame):
        final = parts.gate.sample(solution.gate, None)
    check_output(parts.checks, "gate", parts.gate, frame, "sample()", final, tuple(solution.gate.logits.shape), UNIT)
    gates = torch.round(final * parts.gate.num_levels).numpy().astype(np.uint8)
    active = solution.active.numpy()
    codes = coarser(parts.update.codes(), problem.step_scale)
    integers = {name: value.numpy() for name, value in residual_symbols(codes, solution.latents).items()}
    moving = np.zeros(len(active), bool)
    for value in integers.values():
        moving |= value.any(1)
    touched = np.zeros(len(gates), bool)
    touched[layout.node_of[active[moving]]] = True
    gates = np.where(touched, gates, 0).astype(np.uint8)
    sent = np.flatnonzero(np.repeat(gates != 0, layout.node_counts))
    table = {name: _rows_of(value, active, sent) for name, value in integers.items()}
    table = {name: value for name, value in table.items() if value.any()}
    decoders = {name: value.numpy() for name, value in solution.decoders.items() if name in table}
    steps = {name: codes[name].step for name in table}
    return Delta(gates, parts.gate.num_levels, table, steps, quantise_decoders(decoders))


def _rows_of(values: np.ndarray[Any, Any], active: IntArray, wanted: IntArray) -> np.ndarray[Any, Any]:
    """Rows ``wanted`` of a table whose rows belong to ``active``; rows that took no part are zero."""
    out = np.zeros((len(wanted), values.shape[1]), values.dtype)
    place = np.searchsorted(active, wanted)
    known = (place < len(active)) & (active[np.minimum(place, max(0, len(active) - 1))] == wanted)
    out[known] = values[place[known]]
    return out


def encode(delta: Delta, state: StreamState, index: int) -> EncodedPacket:
    """The packet of a delta; an empty one when nothing changed."""
    if delta.is_empty:
        return encode_empty(frame=index)
    return encode_delta(delta, state.player.layout, state.player.decoders, frame=index)


def step_metrics(
    delta: Delta, after: StreamState, packet: EncodedPacket, solution: Solution, active: torch.Tensor
) -> dict[str, object]:
    """Numbers of one frame step that need no rendering."""
    counts = (after.player.before or after.player.layout).node_counts
    sizes: Mapping[str, int] = packet.sizes
    return {
        "bytes": dict(sizes),
        "active_gaussians": int(counts[delta.gates != 0].sum()),
        "num_gaussians": len(after.player.gaussians),
        "active_gates": int((delta.gates != 0).sum()),
        "num_gates": len(delta.gates),
        "dead_gates": solution.dead_gates,
        "births": 0 if delta.births is None else len(delta.births),
        "candidate_gaussians": len(active),
        "loss": solution.loss,
        "iterations": solution.iterations,
        **cache_metrics(after.session),
    }


def cache_metrics(session: RenderSession | None) -> dict[str, object]:
    """What the renderer keeps from frame to frame; nothing where it keeps nothing."""
    cache = RenderCache() if session is None else session.cache_bytes()
    if not cache.per_view:
        return {}
    per_pair = round(cache.per_camera_and_gaussian, 1)
    known = {"mb": cache.total / 1e6, "cameras": len(cache.per_view), "bytes_per_camera_and_gaussian": per_pair}
    return {"cache": known}
