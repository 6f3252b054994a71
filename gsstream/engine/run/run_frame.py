"""One frame as a run makes it, by any method: tried, compared with what players have, and its packet counted."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.frame0.begin import check_cameras
from gsstream.engine.run.parts_method import PartsMethod
from gsstream.engine.run.player_difference import difference_between
from gsstream.engine.step.metrics import log_packet
from gsstream.engine.step.tools import RunTools
from gsstream.method.base import Step, StreamingMethod
from gsstream.packet import PlayerState, decode_packet

SLOT = "streaming_method"


class RepeatedFrameWarning(UserWarning):
    """A part failed, and its frame was sent as "nothing changed"."""


class SkippedWorkWarning(UserWarning):
    """A part failed in work that follows a frame's packet, which is sound and out; the work was left out."""


def live_method(assembly: Assembly) -> StreamingMethod[Any]:
    """Return the method of a recipe without its guard; the one made of parts over the parts of the recipe."""
    method = assembly.part(SLOT)
    return method.with_slots(assembly) if isinstance(method, PartsMethod) else method  # type: ignore[return-value]


def run_frame(method: StreamingMethod[Any], state: Any, frame: Frame, tools: RunTools) -> Step[Any]:
    """Encode a frame, the first where ``state`` is None, and log the numbers that follow from its packet.

    Where a later frame fails and the recipe says ``stream.on_error: repeat``, the method is called again with the epoch
    scale 0, which it must answer by an empty packet. A packet that carries the state it was decoded to
    (``EncodedPacket.decoded``) is not decoded again, unless every step is checked.

    Raises ComponentError when the method fails, or returns a state that players do not have.
    """

    def work(frame: Frame) -> Step[Any]:
        given = _given(method, frame)
        tools.assembly.where.enter(frame.index)
        with tools.assembly.use(SLOT).errors():
            step = method.begin(given, tools) if state is None else method.step(state, given, tools)
        _check_step(None if state is None else state.player, step, frame, tools)
        return step

    if state is None:
        recipe = tools.assembly.recipe
        name = recipe.streaming_method.name if recipe.streaming_method.name != "parts" else recipe.method
        check_cameras(frame.cameras, method.min_cameras, f"the method {name!r}")
        return work(frame)
    step, error = _tried(work, frame, tools)
    if error is not None:
        if step.status != "empty":
            raise error
        warnings.warn(f"frame {frame.index} repeats the one before it: {error}", RepeatedFrameWarning, stacklevel=2)
    return step


def run_follow_up(
    method: StreamingMethod[Any], state: Any, step: Step[Any], frame: Frame, tools: RunTools
) -> Step[Any]:
    """Do the work that follows a packet; where it fails and the recipe says so, it is left out.

    Raises ComponentError when the method fails, or changes what has been handed out.
    """

    def work(frame: Frame) -> Step[Any]:
        with tools.assembly.use(SLOT).errors(), tools.log.phase("other"):
            found = method.follow_up(state, step, _given(method, frame), tools)
        if found is not step:
            _check_follow_up(step, found, tools)
        return found

    found, error = _tried(work, frame, tools)
    if error is not None:
        said = f"frame {frame.index}: its packet is sound, but the work that follows it failed and is left out: {error}"
        warnings.warn(said, SkippedWorkWarning, stacklevel=2)
    return found


def run_resume(method: StreamingMethod[Any], player: PlayerState, shown: Frame, tools: RunTools) -> Any:
    """Return the state of the method after the last packet of a stream."""
    tools.assembly.where.enter(player.frame)
    with tools.assembly.use(SLOT).errors():
        return method.resume(player, _given(method, shown), tools)


def _tried(
    work: Callable[[Frame], Step[Any]], frame: Frame, tools: RunTools
) -> tuple[Step[Any], ComponentError | ShapeError | None]:
    """The step of a frame; where ``work`` fails and the recipe says so, the step that skips it, and the error."""
    mark = tools.log.mark()
    try:
        return work(frame), None
    except (ComponentError, ShapeError) as error:
        if tools.assembly.recipe.stream.on_error != "repeat":
            raise
        tools.log.give_up(error, mark)
        return work(replace(frame, epoch_scale=0.0)), error


def _given(method: StreamingMethod[Any], frame: Frame) -> Frame:
    """The frame as the method is given it: with images of float32, unless the method is the engine's own."""
    return frame if isinstance(method, PartsMethod) else frame.as_float32()


def _check_step(before: PlayerState | None, step: Step[Any], frame: Frame, tools: RunTools) -> None:
    """Compare a step with what players make of its packet, and log the numbers that follow from it."""
    kind = step.packet.kind.name.lower()
    if step.packet.frame != frame.index or kind != step.status:
        raise _fault(
            tools,
            f"expected a packet of frame {frame.index} of the kind it says, {step.status!r}; got {kind!r} of frame "
            f"{step.packet.frame}",
        )
    player: PlayerState = step.state.player
    # A packet that was decoded when it was made carries what it was decoded to.
    if step.packet.decoded is not player or tools.assembly.checks is Checks.STEP:
        player = decode_packet(before, step.packet.data)
        difference = difference_between(player, step.state.player)
        if difference:
            raise _fault(
                tools,
                f"its state is not what players have after its packet: {difference}. Go on from "
                "decoder()(state.player, packet.data)",
            )
    log_packet(tools.log, player, step.packet)


def _check_follow_up(step: Step[Any], found: Step[Any], tools: RunTools) -> None:
    difference = ""
    if found.packet.data != step.packet.data or found.status != step.status:
        difference = "packet or status"
    elif found.state.player is not step.state.player:
        difference = difference_between(step.state.player, found.state.player)
    if difference:
        raise _fault(
            tools,
            f"its follow_up changed what has been handed out: {difference}. Return dataclasses.replace(step, ...) "
            "with another state of the same player",
        )


def _fault(tools: RunTools, message: str) -> ComponentError:
    tools.assembly.where.pause()  # the step is made: no iteration of it goes on
    return tools.assembly.use(SLOT).fault(message)
