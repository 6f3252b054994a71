"""Running a whole method: what the engine lends it, and what the engine holds it to."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsstream.core.delta import row_gates
from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.frame0.begin import begin, begin_from, check_cameras, exposure_from_meta
from gsstream.engine.assembly.checks import StepChecks
from gsstream.engine.step.context import StepContext
from gsstream.engine.step.frame_step import RepeatedFrameWarning
from gsstream.engine.assembly.guard import fault, guarded
from gsstream.engine.frame0.points import gather_points, with_test_views
from gsstream.engine.keys.resume import check_stream, replay
from gsstream.engine.frame0.root import Progress
from gsstream.engine.state.stream_state import StreamState
from gsstream.method.base import MethodState, Step, StreamingMethod
from gsstream.method.tools import FirstFrame
from gsstream.packet import PacketKind, PlayerState, StreamMeta, StreamReader, decode_packet
from gsstream.render.base import Renderer
from gsstream.source.base import FrameSource


@dataclass(frozen=True)
class WholeTools:
    """What a run lends to its whole method (implements ``gsstream.method.tools.Tools``).

    Arguments:
        meta: makes what the key packet says, from the frame that is to be sent.
        near: near plane of every frame, scene units.
        first: frame 0 of another stream, to be taken over; or None.
        progress: told about the iterations of frame 0.
    """

    parts: Assembly
    source: FrameSource
    rng: Rng
    near: float
    meta: Callable[[Frame], StreamMeta]
    first: PlayerState | None = None
    progress: Progress = lambda *_: None

    @property
    def renderer(self) -> Renderer:
        return self.parts.renderer

    @property
    def background(self) -> tuple[float, float, float]:
        return self.parts.recipe.background

    def epochs(self, frame: Frame) -> int:
        return max(1, round(self.parts.recipe.stream.epochs * frame.effort))

    def first_frame(self, frame: Frame) -> FirstFrame:
        meta = self.meta(frame)
        if self.first is not None:
            step = begin_from(self.parts, self.first, frame, meta, self.rng)
        else:
            seen = with_test_views(self.source, frame) if self.parts.recipe.data.leak == "points" else frame
            points = gather_points(self.source, seen, self.parts.recipe.first_frame, self.rng)
            step = begin(self.parts, points, frame, meta, self.rng, self.progress)
        player = step.state.player
        metrics = {name: step.metrics[name] for name in ("iterations", "seconds")}
        return FirstFrame(player.gaussians, player.layout, player.meta, metrics)

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> OpenFrame:
        return OpenFrame(self.parts, player, previous, frame)


class OpenFrame(StepContext):
    """One frame as a whole method sees it (implements ``gsstream.method.tools.FrameTools``)."""

    def __init__(self, parts: Assembly, player: PlayerState, previous: Frame, frame: Frame) -> None:
        roots = torch.arange(len(player.layout.node_counts))
        forest = Hierarchy(torch.from_numpy(player.layout.node_of), roots, torch.zeros_like(roots))
        self._exposure = exposure_from_meta(player.meta)
        state = StreamState(player, forest, previous, exposure=self._exposure)
        super().__init__(state, frame, parts.renderer, parts.recipe.background)
        self._loss, self._dssim = parts.loss, parts.recipe.loss.dssim
        self._targets: dict[int, Any] = {}
        self._look = StepChecks(parts.checks, frame.index)

    def backward(self, view: int, image: torch.Tensor, tile_mask: torch.Tensor | None = None) -> float:
        if view not in self._targets:
            self._targets[view] = self._loss.prepare(self.image(view))
        raw, look = image.detach(), self._look
        look.iteration += 1
        look("renderer", self._renderer, f"image of view {view}", raw)
        shown = self._exposure.apply(view, raw) if self._exposure else raw
        value, gradient = self._loss.evaluate(shown, self._targets[view], self._dssim, tile_mask)
        look.number("loss", self._loss, f"loss of view {view}", value)
        look("loss", self._loss, f"gradient of the image of view {view}", gradient)
        if self._exposure:
            gradient = self._exposure.pull(view, gradient)
        pull_back([image], [gradient])
        return value


def begin_whole(method: StreamingMethod[Any], tools: WholeTools, frame: Frame) -> Step[Any]:
    """Frame 0 of a whole method, held to its contract. Raises InputError with fewer cameras than it needs."""
    check_cameras(frame.cameras, method.least_cameras, f"the method {type(method).__name__!r}")
    with guarded("whole", method, frame.index):
        return _held(method, None, frame, lambda: method.begin(frame, tools))


def step_whole(method: StreamingMethod[Any], tools: WholeTools, state: MethodState, frame: Frame) -> Step[Any]:
    """A later frame of a whole method, held to its contract.

    Raises ComponentError when the method fails, unless the recipe says ``stream.on_error: repeat``: then the method is
    asked for the same frame as one that is worth nothing, which it has to answer by an empty packet.
    """
    started = time.perf_counter()
    try:
        return _step(method, tools, state, frame)
    except (ComponentError, ShapeError) as error:
        if tools.parts.recipe.stream.on_error == "raise":
            raise
        lost = time.perf_counter() - started
        step = _step(method, tools, state, replace(frame, effort=0.0))
        if step.status != "empty":
            raise  # it does not keep its contract: what it sends instead cannot be trusted either
        warnings.warn(f"frame {frame.index} repeats the one before it: {error}", RepeatedFrameWarning, stacklevel=2)
        seconds = {**step.metrics["seconds"], "failed": lost}
        return replace(step, metrics={**step.metrics, "seconds": seconds, "error": str(error)})


def _step(method: StreamingMethod[Any], tools: WholeTools, state: MethodState, frame: Frame) -> Step[Any]:
    with guarded("whole", method, frame.index):
        return _held(method, state.player, frame, lambda: method.step(state, frame, tools))


def resume_whole(method: StreamingMethod[Any], tools: WholeTools, path: Path) -> MethodState | None:
    """The state after the last complete packet of a stream; None when not even frame 0 is complete.

    Raises OutputError when recipe or recording are not those the stream was written with.
    """
    if not check_stream(tools.parts, path, tools.source.info):
        return None
    with StreamReader(path) as reader:
        player = replay(reader)
        shown = [e.frame for e in reader.frames if e.kind != PacketKind.EMPTY and e.frame <= player.frame]
    frame = tools.source.frame(shown[-1], "train")
    frame = replace(frame, cameras=replace(frame.cameras, near=tools.near))
    with guarded("whole", method, player.frame):
        state: MethodState = method.resume(player, frame, tools)
    return state


def _held(
    method: StreamingMethod[Any], before: PlayerState | None, frame: Frame, make: Callable[[], Step[Any]]
) -> Step[Any]:
    """Make a step; decode its packet as a player would and compare; add the numbers that follow from the packet."""
    started = time.perf_counter()
    step = make()
    seconds = time.perf_counter() - started
    if step.packet.frame != frame.index or step.packet.kind.name.lower() != step.status:
        raise fault(
            f"expected a packet of frame {frame.index} of the kind it says, {step.status!r}; got "
            f"{step.packet.kind.name.lower()!r} of frame {step.packet.frame}", "whole", method, frame.index
        )  # fmt: skip
    player = decode_packet(before, step.packet.data)
    difference = _difference(player, step.state.player)
    if difference:
        raise fault(
            f"its state is not what players have after its packet: {difference}. Go on from "
            "decoder()(state.player, packet.data)", "whole", method, frame.index
        )  # fmt: skip
    return replace(step, metrics={**_facts(player, step), "seconds": {"step": seconds}, **step.metrics})


def _difference(player: PlayerState, claimed: PlayerState) -> str:
    """What differs between two player states, or ""."""
    if player.frame != claimed.frame:
        return f"frame {claimed.frame} instead of {player.frame}"
    for name in ATTRIBUTES:
        want, got = getattr(player.gaussians, name), getattr(claimed.gaussians, name)
        if want.shape != got.shape:
            return f"{name} has the shape {list(got.shape)} instead of {list(want.shape)}"
        if want.tobytes() != got.tobytes():
            return f"{name} is off by up to {float(np.abs(got - want).max()):.3g}"
    for name in ("node_counts", "octree_levels", "cell_sizes"):
        if not np.array_equal(getattr(player.layout, name), getattr(claimed.layout, name)):
            return f"layout: {name}"
    if set(player.decoders) != set(claimed.decoders) or any(
        value.tobytes() != claimed.decoders[name].tobytes() for name, value in player.decoders.items()
    ):
        return "decoders"
    return ""


def _facts(player: PlayerState, step: Step[Any]) -> dict[str, Any]:
    """Sizes and counts, from the packet alone."""
    rows, gates = len(player.gaussians), 0
    if player.delta is not None and player.before is not None:
        born = 0 if player.delta.births is None else len(player.delta.births.parents)
        rows = int((row_gates(player.before, player.delta) > 0).sum())
        gates = int((player.delta.gates != 0).sum()) + born
    elif step.status == "empty":
        rows = 0
    return {
        "bytes": dict(step.packet.sizes),
        "num_gaussians": len(player.gaussians),
        "active_gaussians": rows,
        "num_gates": len(player.layout.node_counts),
        "active_gates": gates,
    }
