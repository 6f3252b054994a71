"""A method that is held to its contract: what it returns is decoded as a player would, and compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.errors import ComponentError
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.assembly.fault import fault
from gsstream.engine.assembly.guard import error_context
from gsstream.engine.frame0.begin import check_cameras
from gsstream.engine.method.parts import PartsMethod
from gsstream.engine.step.metrics import log_packet
from gsstream.method.base import Step, StreamingMethod
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState, decode_packet

SLOT = "streaming_method"


class Checked(StreamingMethod[Any]):
    """Calls a method; its packets and states are compared with what every player has, its errors name it.

    A packet that carries the state it was decoded to (``EncodedPacket.decoded``) is not decoded again, unless every
    step is checked.
    """

    source = "gsstream"
    _method: StreamingMethod[Any]
    _assembly: Assembly

    def __init__(self, method: StreamingMethod[Any], assembly: Assembly) -> None:
        super().__init__()
        vars(self).update(_method=method, _assembly=assembly)

    def begin(self, frame: Frame, tools: Tools) -> Step[Any]:
        recipe, method = self._assembly.recipe, self._method
        name = recipe.streaming_method.name if recipe.streaming_method.name != "parts" else recipe.method
        check_cameras(frame.cameras, method.min_cameras, f"the method {name!r}")
        with self._blaming(frame):
            step = method.begin(self._given(frame), tools)
        return self._compared(None, step, frame, tools)

    def step(self, state: Any, frame: Frame, tools: Tools) -> Step[Any]:
        with self._blaming(frame):
            step = self._method.step(state, self._given(frame), tools)
        return self._compared(state.player, step, frame, tools)

    def follow_up(self, state: Any, step: Step[Any], frame: Frame, tools: Tools) -> Step[Any]:
        with self._blaming(frame), tools.log.phase("other"):
            found = self._method.follow_up(state, step, self._given(frame), tools)
        if found is step:
            return step
        difference = ""
        if found.packet.data != step.packet.data or found.status != step.status:
            difference = "packet or status"
        elif found.metrics:
            difference = "metrics, which are written to tools.log.set(...)"
        elif found.state.player is not step.state.player:
            difference = difference_between(step.state.player, found.state.player)
        if difference:
            raise self._fault(
                f"its follow_up changed what has been handed out: {difference}. Return dataclasses.replace(step, ...) "
                "with another state of the same player"
            )
        return found

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Any:
        with error_context(SLOT, self._method, self._assembly.where):
            return self._method.resume(player, self._given(shown), tools)

    def _given(self, frame: Frame) -> Frame:
        """What the method is given: images of float32, as methods expect them, unless it is the engine's own."""
        return frame if isinstance(self._method, PartsMethod) else frame.as_float32()

    def _blaming(self, frame: Frame) -> Any:
        self._assembly.where.enter(frame.index)
        return error_context(SLOT, self._method, self._assembly.where)

    def _fault(self, message: str) -> ComponentError:
        return fault(message, SLOT, self._method, self._assembly.where)

    def _compared(self, before: PlayerState | None, step: Step[Any], frame: Frame, tools: Tools) -> Step[Any]:
        """Compare a step with what players make of its packet, and log the numbers that follow from it."""
        self._assembly.where.enter(frame.index)
        kind = step.packet.kind.name.lower()
        if step.packet.frame != frame.index or kind != step.status:
            raise self._fault(
                f"expected a packet of frame {frame.index} of the kind it says, {step.status!r}; got {kind!r} of frame "
                f"{step.packet.frame}"
            )
        if step.metrics:
            raise self._fault(f"its step has metrics ({', '.join(step.metrics)}): write numbers to tools.log.set(...)")
        player: PlayerState = step.state.player
        # A packet that was decoded when it was made carries what it was decoded to.
        if step.packet.decoded is not player or self._assembly.checks is Checks.STEP:
            player = decode_packet(before, step.packet.data)
            difference = difference_between(player, step.state.player)
            if difference:
                raise self._fault(
                    f"its state is not what players have after its packet: {difference}. Go on from "
                    "decoder()(state.player, packet.data)"
                )
        if tools.log.numbers.get("bytes") != step.packet.sizes:  # the method made of parts has logged its own
            log_packet(tools.log, player, step.packet)
        return step


def difference_between(player: PlayerState, claimed: PlayerState) -> str:
    """Describe what differs between two player states; empty when nothing does."""
    if player.frame != claimed.frame:
        return f"frame {claimed.frame} instead of {player.frame}"
    for name in ATTRIBUTES:
        want, got = getattr(player.gaussians, name), getattr(claimed.gaussians, name)
        if want.shape != got.shape:
            return f"{name} has the shape {list(got.shape)} instead of {list(want.shape)}"
        if want.tobytes() != got.tobytes():
            return f"{name} is off by up to {float(np.abs(got - want).max()):.3g}"
    for name in ("node_counts", "unit_of", "units"):
        if not np.array_equal(getattr(player.layout, name), getattr(claimed.layout, name)):
            return f"layout: {name}"
    if set(player.decoders) != set(claimed.decoders) or any(
        value.tobytes() != claimed.decoders[name].tobytes() for name, value in player.decoders.items()
    ):
        return "decoders"
    return _history_difference(player, claimed)


def _history_difference(player: PlayerState, claimed: PlayerState) -> str:
    """Describe what differs in what later motions are predicted from; empty when nothing does."""
    memory = {
        "displacement": ("rows", "translation", "rotation"),
        "groups": ("cell", "brightness_bins", "count", "group_of"),
    }
    for name, fields in memory.items():
        want, got = getattr(player.scene, name), getattr(claimed.scene, name)
        if want is None and got is None:
            continue
        if want is None or got is None:
            return f"scene: {name}"
        for field in fields:
            if not _same(getattr(want, field), getattr(got, field)):
                return f"scene: {name}, {field}"
    return ""


def _same(want: float | np.ndarray[Any, Any], got: float | np.ndarray[Any, Any]) -> bool:
    """Return whether two numbers are equal, or two arrays bit by bit."""
    if isinstance(want, np.ndarray) and isinstance(got, np.ndarray):
        return want.tobytes() == got.tobytes()
    return bool(np.array_equal(want, got))
