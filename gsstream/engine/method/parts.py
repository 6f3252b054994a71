"""PartsMethod: the streaming method that is made of parts, one for each slot of a recipe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, final

from gsstream.core.frame import Frame
from gsstream.engine.budget.controller import planned
from gsstream.engine.budget.spent import spent
from gsstream.engine.frame0.begin import begin
from gsstream.engine.frame0.refine import follows_packet, refined
from gsstream.engine.frame0.taken import begin_from
from gsstream.engine.keys.keyframes import refresh
from gsstream.engine.keys.resume import refinement_after, state_after
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.engine.step.frame_step import frame_step
from gsstream.engine.step.metrics import cache_metrics
from gsstream.method.base import StreamingMethod
from gsstream.packet import PlayerState


@final
class PartsMethod(StreamingMethod[StreamState]):
    """Runs the slots of the recipe: structure, confidence, propagation, gate, motion, update, growth, regularizer."""

    source: ClassVar[str] = "gsstream"
    decodes_its_packets: ClassVar[bool] = True

    def reads(self, key: str) -> bool:
        return True

    def begin(self, frame: Frame, tools: Any) -> Step:
        parts = tools.parts
        parts.where.enter(frame.index)
        if tools.first is not None:
            return begin_from(parts, tools.first, frame, tools.meta(frame), tools.rng)
        return begin(parts, tools.points(frame), frame, tools.meta(frame), tools.rng, tools.progress)

    def step(self, state: StreamState, frame: Frame, tools: Any) -> Step:
        allowance, own = tools.allowance, tools.parts
        parts = own if allowance is None else planned(own, allowance.plan)
        step, pace, fitted = frame_step(parts, state, frame, tools.rng, allowance)
        if frame.effort > 0:  # a skipped frame calls no part: it is also the answer to one that failed
            step = replace(step, metrics={**step.metrics, **cache_metrics(step.state.session)})
        if allowance is not None and pace is not None and fitted is not None:
            epochs = step.metrics["iterations"] / len(frame.cameras)
            entry = spent(allowance, pace, fitted, own.recipe.stream, epochs)
            step = replace(step, metrics={**step.metrics, "budget": entry})
        if follows_packet(own.recipe.stream, state, frame):
            return step  # no key packet is due before the last iteration of the refinement
        return refresh(own, refined(own, state, step, frame, tools.rng), frame, tools)

    def follow_up(self, state: StreamState, step: Step, frame: Frame, tools: Any) -> Step:
        parts = tools.parts
        if not follows_packet(parts.recipe.stream, state, frame):
            return step
        return refined(parts, state, step, frame, tools.rng)

    def resume(self, player: PlayerState, shown: Frame, tools: Any) -> StreamState:
        state = replace(state_after(tools.parts, tools.since_key(), tools.rng), previous=shown)
        return replace(state, refinement=refinement_after(tools.parts, state, tools))
