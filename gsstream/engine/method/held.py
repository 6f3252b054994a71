"""Calling a method, and holding it to its contract: what it returns is decoded as a player would, and compared."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.changes import changing_rows, row_gates
from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.fault import fault
from gsstream.engine.frame0.begin import check_cameras
from gsstream.engine.step.tools import RunTools
from gsstream.method.base import MethodState, Step
from gsstream.packet import PlayerState, decode_packet


class RepeatedFrameWarning(UserWarning):
    """A part failed, and its frame was sent as "nothing changed"."""


class LeftOutWarning(UserWarning):
    """A part failed in work that follows a frame's packet, which is sound and out; the work was left out."""


def begin_held(tools: RunTools, frame: Frame) -> Step[Any]:
    """Make frame 0. Raises InputError with fewer cameras than the method needs, ComponentError when it fails."""
    parts = tools.parts
    name = parts.recipe.stepper.name if parts.recipe.stepper.name != "parts" else parts.recipe.method
    check_cameras(frame.cameras, parts.stepper.least_cameras, f"the method {name!r}")
    parts.where.enter(frame.index)
    return _held(parts, None, frame, lambda: parts.stepper.begin(frame, tools))


def step_held(tools: RunTools, state: MethodState, frame: Frame) -> Step[Any]:
    """Make a later frame.

    Arguments:
        tools: what the run lends to its method.
        state: after the frame before.
        frame: training images of this frame.

    Raises ComponentError when the method fails, unless the recipe says ``stream.on_error: repeat``: then the method is
    asked for the same frame as one that is worth nothing, which it has to answer by an empty packet.
    """
    # What does not answer by an empty packet breaks its contract: what it sends instead cannot be trusted either.
    found, error = _or_worth_nothing(
        tools, frame, lambda now: _step(tools, state, now), lambda step: step.status == "empty"
    )
    if error is not None:
        warnings.warn(f"frame {frame.index} repeats the one before it: {error}", RepeatedFrameWarning, stacklevel=2)
    return found


def follow_up_held(tools: RunTools, state: MethodState, step: Step[Any], frame: Frame) -> Step[Any]:
    """Do the work of a later frame that follows its packet; its seconds are added to those of the frame.

    Arguments:
        tools: what the run lends to its method.
        state: before the frame.
        step: of the frame; its packet has been handed out.
        frame: training images of the frame.

    Raises ComponentError when the method fails, unless the recipe says ``stream.on_error: repeat``: then the method is
    asked for the same work of a frame that is worth nothing.
    """
    found, error = _or_worth_nothing(tools, frame, lambda now: _follow_up(tools, state, step, now), lambda _: True)
    if error is not None:
        warnings.warn(
            f"frame {frame.index}: its packet is sound, but the work that follows it failed and is left out: {error}",
            LeftOutWarning, stacklevel=2
        )  # fmt: skip
    return found


def _or_worth_nothing(
    tools: RunTools, frame: Frame, make: Callable[[Frame], Step[Any]], sound: Callable[[Step[Any]], bool]
) -> tuple[Step[Any], Exception | None]:
    """What ``make`` makes of a frame; where that fails and the recipe says so, of one without worth, and the failure.

    The failure is raised again when the second answer is not ``sound``.
    """
    started = time.perf_counter()
    try:
        return make(frame), None
    except (ComponentError, ShapeError) as error:
        if tools.parts.recipe.stream.on_error == "raise":
            raise
        lost = time.perf_counter() - started
        step = make(replace(frame, effort=0.0))
        if not sound(step):
            raise
        seconds = {**step.metrics["seconds"], "failed": lost}
        return replace(step, metrics={**step.metrics, "seconds": seconds, "error": str(error)}), error


def _step(tools: RunTools, state: MethodState, frame: Frame) -> Step[Any]:
    parts = tools.parts
    parts.where.enter(frame.index)
    return _held(parts, state.player, frame, lambda: parts.stepper.step(state, frame, tools))


def _follow_up(tools: RunTools, state: MethodState, step: Step[Any], frame: Frame) -> Step[Any]:
    """Let the method do what follows a packet, and see that it leaves alone what players have."""
    parts = tools.parts
    parts.where.enter(frame.index)
    started = time.perf_counter()
    found: Step[Any] = parts.stepper.follow_up(state, step, frame, tools)
    seconds = time.perf_counter() - started
    parts.where.enter(frame.index)
    if found is step:
        return step
    difference = ""
    if found.packet.data != step.packet.data or found.status != step.status:
        difference = "packet or status"
    elif found.state.player is not step.state.player:
        difference = difference_between(step.state.player, found.state.player)
    if difference:
        raise fault(
            f"its follow_up changed what has been handed out: {difference}. Return dataclasses.replace(step, ...) with "
            "another state of the same player", "stepper", parts.part("stepper"), parts.where
        )  # fmt: skip
    metrics = {**step.metrics, **found.metrics}
    if metrics["seconds"] == step.metrics["seconds"]:
        metrics["seconds"] = {**metrics["seconds"], "follow_up": seconds}
    return replace(found, metrics=metrics)


def _held(parts: Assembly, before: PlayerState | None, frame: Frame, make: Callable[[], Step[Any]]) -> Step[Any]:
    """Make a step; decode its packet as a player would and compare; add the numbers that follow from the packet."""
    started = time.perf_counter()
    step = make()
    seconds = time.perf_counter() - started
    parts.where.enter(frame.index)
    method = parts.part("stepper")
    if step.packet.frame != frame.index or step.packet.kind.name.lower() != step.status:
        raise fault(
            f"expected a packet of frame {frame.index} of the kind it says, {step.status!r}; got "
            f"{step.packet.kind.name.lower()!r} of frame {step.packet.frame}", "stepper", method, parts.where
        )  # fmt: skip
    if parts.stepper.decodes_its_packets:
        return step
    player = decode_packet(before, step.packet.data)
    difference = difference_between(player, step.state.player)
    if difference:
        raise fault(
            f"its state is not what players have after its packet: {difference}. Go on from "
            "decoder()(state.player, packet.data)", "stepper", method, parts.where
        )  # fmt: skip
    return replace(step, metrics={**_facts(player, step), "seconds": {"step": seconds}, **step.metrics})


def difference_between(player: PlayerState, claimed: PlayerState) -> str:
    """Say what differs between two player states; empty when nothing does."""
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
    """Say what differs in what later motions are predicted from; empty when nothing does."""
    for name, fields in (("moved", ("rows", "shift", "turn")), ("groups", ("cell", "shades", "count", "group_of"))):
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
    """Say whether two numbers are equal, or two arrays bit by bit."""
    if isinstance(want, np.ndarray) and isinstance(got, np.ndarray):
        return want.tobytes() == got.tobytes()
    return bool(np.array_equal(want, got))


def _facts(player: PlayerState, step: Step[Any]) -> dict[str, Any]:
    """Sizes and counts, from the packet alone."""
    rows = sent = len(player.gaussians)
    gates = 0
    if player.delta is not None and player.before is not None:
        born = 0 if player.delta.births is None else len(player.delta.births.parents)
        rows = born + (0 if player.delta.residual is None else changing_rows(player.delta.residual))
        sent = int((row_gates(player.before, player.delta) > 0).sum())
        gates = int((player.delta.gates(player.before) != 0).sum()) + born
    elif step.status == "empty":
        rows = sent = 0
    return {
        "bytes": dict(step.packet.sizes),
        "num_gaussians": len(player.gaussians),
        "active_gaussians": rows,
        "sent_gaussians": sent,
        "num_gates": len(player.layout.node_counts),
        "active_gates": gates,
    }
