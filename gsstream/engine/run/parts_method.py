"""PartsMethod: the streaming method that is made of parts, one for each slot of a recipe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, final

from gsstream.core.errors import InputError
from gsstream.core.frame import Frame
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import begin
from gsstream.engine.frame0.refine import (
    is_to_be_refined,
    refine_after_packet,
    refine_first_frame,
    runs_after_packet,
    start_refinement,
    with_time_for_keys,
)
from gsstream.engine.frame0.reuse import reuse_first_frame
from gsstream.engine.keys.keyframes import key_packet_if_due
from gsstream.engine.keys.resume import earlier_pictures, refinement_after, state_after
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.engine.step.frame_step import frame_step
from gsstream.engine.step.lamp import resumed_in_light
from gsstream.engine.step.light import looked_after
from gsstream.method.base import StreamingMethod
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState


@final
class PartsMethod(StreamingMethod[StreamState]):
    """Runs the slots of the recipe: structure, confidence, propagation, gate, motion, update, growth, regularizer."""

    source: ClassVar[str] = "gsstream"
    recipe_keys: ClassVar[tuple[str, ...]] = ("*",)

    _slots: Assembly | None

    def __init__(self, config: Any = None, slots: Assembly | None = None) -> None:
        super().__init__(config)
        vars(self).update(_slots=slots)

    def with_slots(self, slots: Assembly) -> PartsMethod:
        """Return this method over the live parts of a recipe."""
        return PartsMethod(self.config, slots)

    @property
    def slots(self) -> Assembly:
        """The live parts. Raises InputError before :meth:`with_slots`."""
        if self._slots is None:
            raise InputError("the method has no parts yet: expected PartsMethod().with_slots(assemble(...))")
        return self._slots

    def begin(self, frame: Frame, tools: Tools) -> Step:
        make = begin if tools.first is None else reuse_first_frame
        step = make(self.slots, frame, tools)
        if is_to_be_refined(self.slots.recipe.stream, step.state.player):
            step = replace(step, state=replace(step.state, refinement=start_refinement(step.state.player)))
        return step

    def step(self, state: StreamState, frame: Frame, tools: Tools) -> Step:
        if state.refinement is not None:
            state = with_time_for_keys(self.slots.recipe, state, frame)
        step = frame_step(self.slots, state, frame, tools)
        if state.refinement is not None:
            if runs_after_packet(self.slots.recipe.stream, state.refinement, frame):
                return step  # no key packet is due before the last iteration of the refinement
            step = refine_first_frame(self.slots, state, step, frame=frame, tools=tools)
        return key_packet_if_due(self.slots, step, frame, tools, before=state.player)

    def follow_up(self, state: StreamState, step: Step, frame: Frame, tools: Tools) -> Step:
        return (
            step if state.refinement is None else refine_after_packet(self.slots, state, step, frame=frame, tools=tools)
        )

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> StreamState:
        earlier = earlier_pictures(self.slots, tools)
        state = replace(state_after(self.slots, tools.since_key(), tools.rng), previous=shown, earlier=earlier)
        state = resumed_in_light(state, tools.since_key())
        state = looked_after(self.slots, state, tools.since_key(), tools)
        return replace(state, refinement=refinement_after(self.slots, state, tools))
