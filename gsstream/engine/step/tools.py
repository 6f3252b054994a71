"""What a run lends to its method (implements ``gsstream.method.tools.Tools``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from gsstream.core.frame import Frame, PointCloud
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.pace import Allowance
from gsstream.engine.frame0.begin import begin, exposure_from_meta
from gsstream.engine.frame0.optimise import Progress
from gsstream.engine.frame0.taken import begin_from
from gsstream.engine.step.context import FrameView
from gsstream.method.tools import FirstFrame
from gsstream.packet import PlayerState, StreamMeta
from gsstream.render.base import Renderer


@dataclass(frozen=True)
class RunTools:
    """What a run lends to its method.

    Arguments:
        parts: the live parts of the recipe.
        rng: random streams by name and frame.
        meta: makes what a key packet says about the run, from the frame that is to be sent.
        points: makes the seeds of frame 0, from its training images.
        first: frame 0 of another stream, to be taken over; or None.
        progress: told about the iterations of frame 0.
        allowance: what a budget lets the next frame spend; None: what the recipe says.
        refuse_key: number of Gaussians -> why a key packet cannot be paid for now, or None.
        replay: the states of players since the last key packet, while a stream is being resumed.
        images: frame index -> its training images, while a stream is being resumed.
    """

    parts: Assembly
    rng: Rng
    meta: Callable[[Frame], StreamMeta]
    points: Callable[[Frame], PointCloud]
    first: PlayerState | None = None
    progress: Progress = lambda *_: None
    allowance: Allowance | None = None
    refuse_key: Callable[[int], str | None] = lambda _: None
    replay: Callable[[], Iterator[PlayerState]] = lambda: iter(())
    images: Callable[[int], Frame] | None = None

    @property
    def renderer(self) -> Renderer:
        return self.parts.renderer

    @property
    def background(self) -> tuple[float, float, float]:
        return self.parts.recipe.background

    def epochs(self, frame: Frame) -> int:
        return max(1, round(self.parts.recipe.stream.epochs * frame.effort))

    def since_key(self) -> Iterator[PlayerState]:
        return self.replay()

    def first_frame(self, frame: Frame) -> FirstFrame:
        meta = self.meta(frame)
        if self.first is not None:
            step = begin_from(self.parts, self.first, frame, meta, self.rng)
        else:
            step = begin(self.parts, self.points(frame), frame, meta, self.rng, self.progress)
        player = step.state.player
        metrics = {name: step.metrics[name] for name in ("iterations", "seconds")}
        return FirstFrame(player.gaussians, player.layout, player.meta, metrics)

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> FrameView:
        roots = torch.arange(len(player.layout.node_counts))
        forest = Hierarchy(torch.from_numpy(player.layout.node_of), roots, torch.zeros_like(roots))
        gaussians, exposure = player.gaussians.map(torch.from_numpy), exposure_from_meta(player.meta)
        return FrameView(self.parts, gaussians, forest, frame, previous, exposure)
