"""One later frame of a method made of parts, top to bottom: (StreamState, Frame) -> Outcome.

what changed -> motion -> confidence, gates -> optimise -> growth -> code -> decode own packet -> next state
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from gsstream.core.changes import Delta
from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.core.storage import packed
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.pace import Allowance, EpochScheduler, scheduled
from gsstream.engine.budget.trim import Fitted
from gsstream.engine.state.follow import follow
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.engine.step.active.candidates import CHANGE_VOTES, candidates
from gsstream.engine.step.active.change import detect_change
from gsstream.engine.step.active.tiles import tile_weights
from gsstream.engine.step.clock import PhaseClock
from gsstream.engine.step.encode import encode_frame
from gsstream.engine.step.growth import grown
from gsstream.engine.step.harden import harden
from gsstream.engine.step.keep import kept_session
from gsstream.engine.step.metrics import step_metrics
from gsstream.engine.step.motion import moved
from gsstream.engine.step.optimise import optimise
from gsstream.engine.step.problem import Problem
from gsstream.packet import decode_packet, encode_empty


class Outcome(NamedTuple):
    """A step, and what a budget wants to know of it: the pace its passes were held to, and what fitting gave up."""

    step: Step
    pace: EpochScheduler | None = None
    fitted: Fitted | None = None


def frame_step(
    parts: Assembly, state: StreamState, frame: Frame, rng: Rng, allowance: Allowance | None = None
) -> Outcome:
    """Advance the stream by one frame. Pure: a failure leaves ``state`` as it was.

    Arguments:
        parts: what the method is made of; its recipe says what a frame may cost.
        state: after the frame before.
        frame: training images of this frame.
        rng: random streams by name and frame.
        allowance: what a budget lets the frame spend; None: what the recipe says.

    Raises ComponentError when a part fails.
    """
    clock, stream = PhaseClock(), parts.recipe.stream
    parts.where.enter(frame.index)
    if frame.effort == 0:  # its pictures count for nothing: a source that is behind has not even read them
        return still(state, frame, clock)
    with clock.phase("change"):
        change = detect_change(state.previous, frame, stream.change_threshold)
    if change is not None and change.share == 0:
        return still(state, frame, clock)
    with clock.phase("motion"):
        motions, scene, view = moved(parts, state, frame, change, rng, allowance)
    with clock.phase("confidence"):
        confidence = parts.propagation.propagate(parts.confidence.estimate(view), state.hierarchy)
        logits = parts.gate.init(confidence)
        open_probability = parts.gate.open_probability(logits)
        able = view.changed_rows(CHANGE_VOTES)
        rows = candidates(able, open_probability, state.hierarchy, stream.active_threshold)
    with clock.phase("optimise"):
        generator, views = rng.stream("frame", frame.index), len(frame.cameras)
        problem = Problem(
            scene.layout, state.hierarchy, rows, view.gaussians.rows(rows), logits, state.decoders,
            view.session_for(rows), lambda index: view.view_target(
                index, tile_weights(change, index, stream.quiet_tiles, generator)
            ), views, frame.cameras.width * frame.cameras.height, generator,
            1.0 if allowance is None else allowance.plan.step_scale,
        )  # fmt: skip
        schedule = scheduled(stream, frame, allowance)
        solution = optimise(parts, problem, schedule)
        residual = harden(parts, problem, solution)
    with clock.phase("growth"):
        delta = grown(parts, state, Delta(motions).with_residual(residual), view, rng)
    with clock.phase("code"):
        most = None if allowance is None else allowance.plan.max_bytes
        fitted = encode_frame(delta, state.player, frame.index, solution, parts.recipe.codec.trim, most)
        player = decode_packet(state.player, fitted.packet.data)
    with clock.phase("keep"):
        # A frame that changed nothing is not what the scene shows: the next one is compared with the last that did, so
        # that a change too slow to see from frame to frame adds up until it is seen.
        unchanged = fitted.delta.is_empty
        shown = state.previous if unchanged else replace(frame, images=packed(frame.images, parts.recipe.data.images))
        session = kept_session(view, scene, fitted.delta, player)
        after = follow(replace(state, previous=shown, session=session), player)
    metrics = step_metrics(fitted.delta, after, fitted.packet, solution, len(rows))
    metrics |= {"changed_tiles": 1.0 if change is None else change.share, "seconds": clock.seconds}
    pace = schedule if isinstance(schedule, EpochScheduler) and len(rows) else None
    return Outcome(Step(after, fitted.packet, "empty" if unchanged else "delta", metrics), pace, fitted)


def still(state: StreamState, frame: Frame, clock: PhaseClock) -> Outcome:
    """Return the step of a frame in which no tile of any view changed, or that is skipped: an empty packet.

    Arguments:
        state: after the frame before.
        frame: training images of this frame.
        clock: of its phases.
    """
    with clock.phase("code"):
        packet = encode_empty(frame=frame.index)
        after = replace(state, player=decode_packet(state.player, packet.data))
    # No part and no renderer is called here, because this step is also made after a part has failed.
    metrics = step_metrics(Delta(), replace(after, session=None), packet, None, 0)
    return Outcome(Step(after, packet, "empty", {**metrics, "changed_tiles": 0.0, "seconds": clock.seconds}))

