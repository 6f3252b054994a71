"""Encoder: frames in, packets out. The one way to encode, under sessions, benchmarks, the contract kit and scripts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, cast

import torch

from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud, packed_frame
from gsstream.core.log import FrameLog
from gsstream.core.names import last_part, without_places
from gsstream.core.rng import Rng
from gsstream.core.world import snap_cameras
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.controller import Controller
from gsstream.engine.budget.plan import unlimited
from gsstream.engine.frame0.begin import CARRIED
from gsstream.engine.frame0.optimise import Progress
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.frame0.reproject import to_stream_coordinates
from gsstream.engine.frame0.reuse import point_cloud_of
from gsstream.engine.keys.resume import check_stream, read_end, states_since_key
from gsstream.engine.run.run_frame import live_method, run_follow_up, run_frame, run_resume
from gsstream.engine.step.tools import RunTools
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.origin import public_uri
from gsstream.input.seeds.shell import mean_color
from gsstream.metrics import peak_memory_mb
from gsstream.packet import EncodedPacket, PlayerState, StreamMeta
from gsstream.recipe.budget import sized

#: Makes the seeds of frame 0 from its training images.
Seeds = Callable[[Frame], PointCloud]


@dataclass(frozen=True)
class Callbacks:
    """Functions that an encoder calls while it works.

    Arguments:
        packet: every packet, as soon as it is made and before the work that follows it (``follow_up`` of a method);
            what it does counts as part of the frame.
        progress: iterations of frame 0.
    """

    packet: Callable[[EncodedPacket], object] = lambda _: None
    progress: Progress = lambda *_: None


@dataclass(frozen=True)
class EncodedFrame:
    """A frame that is encoded.

    Arguments:
        state: state of the method after the frame; ``state.player`` is what every player has.
        packet: what a player reads.
        status: kind of the packet.
        metrics: what the frame cost: its line of ``metrics.jsonl``.
    """

    state: Any
    packet: EncodedPacket
    status: Literal["key", "delta", "empty"]
    metrics: Mapping[str, Any]


class Encoder:
    """Encodes the frames of one recording with one method, in memory.

    :meth:`encode` takes the frames in order and returns an :class:`EncodedFrame` for each. A frame that fails leaves
    the encoder as it was. ``callbacks.packet`` gets a packet as soon as it is made; some methods work on after it in
    the same call.

    Arguments:
        assembly: the live parts of a recipe (``engine.assembly.assemble``).
        info: cameras, frames per second and names of the recording.
        seeds: function that makes the points frame 0 starts from; None: a plane sweep over its training images.
        first_frame: frame 0 of another stream, used instead of a reconstruction.
        callbacks: functions called with every packet and with the progress of frame 0.
        transform_cameras: transform cameras of frames from recording coordinates to those of ``info``.
    """

    def __init__(
        self,
        assembly: Assembly,
        info: SourceInfo,
        seeds: Seeds | None = None,
        *,
        first_frame: PlayerState | None = None,
        callbacks: Callbacks | None = None,
        transform_cameras: bool = False,
    ) -> None:
        held = sized(assembly.recipe.budget, info.fps)
        #: What keeps frames to the budget; None where the recipe sets none.
        self.controller = Controller(held, assembly.recipe.stream) if held.limits_anything else None
        self._unlimited = unlimited(assembly.recipe.stream)
        self.assembly = replace(assembly, recipe=assembly.recipe.model_copy(update={"budget": held}))
        self.info, self._transform_cameras = info, transform_cameras
        self.rng = Rng(assembly.recipe.seed)
        self.near_plane = assembly.recipe.near * info.train.extent
        #: State after the last frame; None before frame 0.
        self.state: Any = None
        self._first = None if first_frame is None else to_stream_coordinates(first_frame, info.world)
        self._seeds, self._listeners = seeds or self._swept, callbacks or Callbacks()

    @property
    def assembly(self) -> Assembly:
        """The live parts; setting them makes the method anew."""
        return self._assembly

    @assembly.setter
    def assembly(self, assembly: Assembly) -> None:
        self._assembly = assembly
        self.method = live_method(assembly)

    def encode(self, frame: Frame) -> EncodedFrame:
        """Encode the next frame: the first as a key packet, later ones as the method decides.

        Arguments:
            frame: training images, of float32, uint8 (255 is 1.0) or what :meth:`Frame.as_stored` converts; its index
                follows that of the frame before. The first may have any, and the stream then begins there.

        Raises:
            ShapeError: images that do not fit the cameras, or values outside [0, 1].
            ComponentError: a part fails and the recipe says ``stream.on_error: raise``. Where it fails in the work that
                follows a packet, that packet has been handed out; the same frame gives it again.
        """
        frame = frame.as_stored()
        frame.validate()
        if self.state is not None and frame.index != self.state.player.frame + 1:
            expected = self.state.player.frame + 1
            raise InputError(f"frame {frame.index}: expected frame {expected}, frames are encoded in order")
        if self.assembly.background != (background := self._background(frame)):
            self.assembly = replace(self.assembly, background=background)
        frame, log, worked = self.with_near_plane(frame), FrameLog(), time.process_time()
        tools = self._tools(log=log)
        if self.controller is not None:
            budget = self.controller.allow(log, first=self.state is None)
            tools = replace(tools, budget=budget, key_refusal=partial(self.controller.key_refusal, budget))
        with one_torch_thread():
            step = run_frame(self.method, self.state, frame, tools)
        step = replace(step, packet=replace(step.packet, decoded=None))  # a queue of packets must not hold scenes
        self._listeners.packet(step.packet)
        if self.state is not None:  # only now, so that the packet is not delayed by it
            with one_torch_thread():
                step = run_follow_up(self.method, self.state, step, frame=frame, tools=tools)
        if self.controller is not None:
            # The refinement of a capture takes the time that the stream leaves (``engine.frame0.refine``).
            idle = 0.0 if frame.arrival is None else log.seconds("refine")
            self.controller.settle(step, tools.budget, len(frame.cameras), log, idle=idle)
        log.set(cpu_seconds=time.process_time() - worked, peak_memory_mb=peak_memory_mb())
        self.state = step.state
        return EncodedFrame(
            step.state, step.packet, step.status, {"frame": frame.index, "status": step.status, **log.entry()}
        )

    def resume(self, stream: Path, image: Callable[[int], Frame], last: int | None = None) -> int | None:
        """Go on after the last sound packet of a stream that this method wrote; return that frame's index.

        Arguments:
            stream: file that this method wrote.
            image: frame index -> its training images.
            last: go on after this frame, whatever the stream holds beyond it.

        Returns:
            None when the stream holds no complete frame 0: then the encoder begins there.

        Raises OutputError when the recipe or the recording is not the one the stream was written with.
        """
        # Checked before the replay, which with the parts of another recipe would fail with a less helpful message.
        if not check_stream(self.assembly, stream, self.info) or (last is not None and last < 0):
            return None
        end = read_end(stream, last)
        # The title is what the stream says: equal recipes may be called otherwise by another version.
        meta = end.player.meta
        self.assembly = replace(self.assembly, title=meta.title, background=meta.background)
        # The last one is kept, because the frame that the scene shows may be asked for once more.
        recorded = lru_cache(maxsize=1)(lambda index: self.with_near_plane(image(index)).as_stored())
        tools = self._tools(replay=lambda: states_since_key(stream, end), recorded=recorded)
        with one_torch_thread():
            self.state = run_resume(self.method, end.player, packed_frame(recorded(end.shown)), tools)
        return end.player.frame

    def with_near_plane(self, frame: Frame) -> Frame:
        """Return the frame with the near plane that the recipe gives this rig, in the stream's coordinates."""
        cameras = frame.cameras
        if self._transform_cameras:
            cameras = snap_cameras(self.info.world.inverse_cameras(cameras))
        return replace(frame, cameras=replace(cameras, near_plane=self.near_plane))

    def _tools(self, **changes: Any) -> RunTools:
        return RunTools(
            self.assembly,
            self.rng,
            self._meta,
            self._points,
            budget=self._unlimited,
            first=self._first,
            progress=self._listeners.progress,
            **changes,
        )

    def _points(self, frame: Frame) -> PointCloud:
        """What frame 0 starts from: seeds, or the centres of the Gaussians that are taken over."""
        return self._seeds(frame.as_float32()) if self._first is None else point_cloud_of(self._first)

    def _background(self, frame: Frame) -> tuple[float, float, float]:
        """The colour behind everything, that of frame 0 from then on; a scene that is taken over brings its own."""
        if self.state is not None:
            return cast("tuple[float, float, float]", self.state.player.meta.background)
        if self._first is not None:
            return self._first.meta.background
        wanted = self.assembly.recipe.background
        return mean_color(frame.as_float32().images) if wanted == "auto" else wanted

    def _swept(self, frame: Frame) -> PointCloud:
        return gather_points(None, frame, self.assembly.recipe.first_frame, device=self.assembly.renderer.device)

    def _meta(self, frame: Frame) -> StreamMeta:
        info, recipe = self.info, self.assembly.recipe
        distributions = {"gsstream", *self.assembly.distributions}
        known = {} if self.state is None else self.state.player.meta.extra
        carried = {name: known[name] for name in CARRIED if name in known}
        origin = {"source_uri": public_uri(info.uri), "licence": info.licence, "title": self.assembly.title}
        return StreamMeta(
            method=recipe.method,
            source=last_part(info.name),
            recipe=without_places(recipe.model_dump(mode="json")),
            train=frame.cameras,
            test=replace(info.test, near_plane=self.near_plane),
            fps=info.fps,
            background=self.assembly.background,
            plugins={name: version(name) for name in sorted(distributions)},
            extra={**origin, **carried},
            world=info.world,
        )


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run the body with one thread of torch, and restore the number afterwards.

    Torch's share of a frame is elementwise work on few rows: more threads cost more than they give, and spin against
    the native kernels' own pool. One thread also keeps its sums, and so the bytes, independent of the machine's cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
