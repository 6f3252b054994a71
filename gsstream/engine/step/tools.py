"""What a run lends to its method (implements ``gsstream.method.tools.Tools``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch

from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.log import FrameLog
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import begin, shell_behind
from gsstream.engine.frame0.optimise import Progress
from gsstream.engine.frame0.reuse import reuse_first_frame
from gsstream.engine.state.colour_maps import exposure_from_meta
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.method.budget import FrameBudget
from gsstream.method.tools import FirstFrame
from gsstream.packet import PlayerState, StreamMeta
from gsstream.parts.backend.base import Renderer


def _not_resuming(index: int) -> Frame:
    raise InputError(f"frame {index} was asked for: recorded frames can be read only while a stream is resumed")


@dataclass(frozen=True)
class RunTools:
    """What a run lends to its method."""

    assembly: Assembly  # the live parts of the recipe
    rng: Rng  # random streams by name and frame
    meta: Callable[[Frame], StreamMeta]  # makes what a key packet says about the run, from the frame that is to be sent
    points: Callable[[Frame], PointCloud]  # makes the seeds of frame 0, from its training images
    budget: FrameBudget  # what the frame may cost
    log: FrameLog = field(default_factory=FrameLog)  # the record of the frame
    first: PlayerState | None = None  # frame 0 of another stream, to be taken over; or None
    progress: Progress = lambda *_: None  # told about the iterations of frame 0
    #: Number of Gaussians -> why a key packet cannot be paid for now, or None.
    key_refusal: Callable[[int], str | None] = lambda _: None
    #: The states of players since the last key packet, while a stream is being resumed.
    replay: Callable[[], Iterator[PlayerState]] = lambda: iter(())
    #: Frame index -> its training images, while a stream is being resumed.
    recorded: Callable[[int], Frame] = _not_resuming

    @property
    def renderer(self) -> Renderer:
        return self.assembly.renderer

    @property
    def background(self) -> tuple[float, float, float]:
        return self.assembly.background

    def epochs(self, frame: Frame) -> int:
        return max(1, round(self.budget.epochs * frame.epoch_scale))

    def since_key(self) -> Iterator[PlayerState]:
        return self.replay()

    def first_frame(self, frame: Frame) -> FirstFrame:
        make = begin if self.first is None else reuse_first_frame
        player = make(self.assembly, frame, self).state.player
        return FirstFrame(player.gaussians, player.layout, player.meta)

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> EngineContext:
        roots = torch.arange(len(player.layout.node_counts))
        forest = Hierarchy(torch.from_numpy(player.layout.node_of), roots, torch.zeros_like(roots))
        exposure, shell = exposure_from_meta(player.meta), shell_behind(self.assembly, player)
        state = StreamState(player, forest, previous, exposure=exposure, shell=shell)
        return EngineContext(self.assembly, state, frame, self.log)
