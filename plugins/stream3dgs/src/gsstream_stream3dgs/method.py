"""3DGStream (Sun et al., CVPR 2024) as a method of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
import torch

from gsstream.api import (
    Delta,
    Frame,
    FrameTools,
    Layout,
    PlayerState,
    RowEdit,
    Scene,
    Step,
    StreamingMethod,
    Tools,
    apply_delta,
    send_delta,
    send_key,
)
from gsstream.blocks import replace_with_copies, rows_in_changed_tiles
from gsstream_stream3dgs.motion import coded_cache, fitted_cache
from gsstream_stream3dgs.settings import Stream3DGSConfig


@dataclass(frozen=True)
class Stream3DGSState:
    """``player``: what every player has. ``previous``: the images its scene shows. ``number``: that of Gaussians kept.
    """

    player: PlayerState
    previous: Frame
    number: int


@final
class Stream3DGS(StreamingMethod[Stream3DGSState]):
    """Moves Gaussians by a network and adds some for a frame (paper: Sun et al., CVPR 2024).

    In every frame a hash grid with a small network is fitted, which gives every Gaussian in the box a shift and a turn;
    then Gaussians are copied where the images still pull, fitted, and given up in the next frame. What is sent are the
    weights, births and deaths; or, instead of the weights, the rigid motions of small cells that come nearest to them.
    Where this differs from what is published, and why: README of this plugin.
    """

    source = "3DGStream (Sun et al. 2024)"

    Config = Stream3DGSConfig
    recipe_keys = ("stream.epochs",)

    def begin(self, frame: Frame, tools: Tools) -> Step[Stream3DGSState]:
        first = tools.first_frame(frame)
        number = len(first.gaussians)
        layout = Layout.flat(number, frame.cameras.extent)
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(Stream3DGSState(player, frame, number), packet, "key")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Stream3DGSState:
        return Stream3DGSState(player, shown, len(next(tools.since_key()).gaussians))

    def step(self, state: Stream3DGSState, frame: Frame, tools: Tools) -> Step[Stream3DGSState]:
        with tools.log.phase("motion"):
            if frame.effort == 0 or np.array_equal(state.previous.images, frame.images):
                return self._send(state, frame, Delta())
            epochs = tools.epochs(frame)
            for_births = max(1, round(self.config.births.share * epochs)) if self.config.births.share else 0
            scene = state.player.scene
            work = tools.open(state.player, state.previous, frame)
            cache, means = self.config.cache, work.gaussians.means
            rows = rows_in_changed_tiles(work.session, means, state.previous, frame, cache.change, cache.votes)
            # Those of the frame before are given up: they neither move nor hide what does.
            rows = rows[rows < state.number]
            work = work.on(work.gaussians.rows(slice(0, state.number)))
            passes = max(1, epochs - for_births)
            found = fitted_cache(scene, work, rows, passes, self.config.cache, tools.rng) if len(rows) else None
            said = None if found is None else coded_cache(scene, *found, frame.cameras, self.config.cache)
            moves = Delta(() if said is None else (said,))
            moved = apply_delta(scene, moves)
            work = work.on(moved.gaussians.map(torch.from_numpy))  # what was rendered of the scene before goes
        with tools.log.phase("growth"):
            change = self._rows(moved, state.number, work, for_births, tools)
        with tools.log.phase("code"):
            step = self._send(state, frame, moves.with_row_edit(change))
        tools.log.set(iterations=epochs * len(frame.cameras))
        return step

    def _rows(self, scene: Scene, number: int, work: FrameTools, epochs: int, tools: Tools) -> RowEdit:
        """Those of the frame before leave, which stand behind the rows of frame 0; then this frame's are born."""
        deaths = np.arange(number, len(scene.gaussians))
        if not epochs:
            return RowEdit(removed=deaths)
        births = self.config.births
        return replace_with_copies(
            scene, deaths, work, epochs, tools.rng, gradient=births.gradient, most=births.most, rounds=births.rounds,
            prune_opacity=births.prune_opacity,
        )  # fmt: skip

    def _send(self, state: Stream3DGSState, frame: Frame, delta: Delta) -> Step[Stream3DGSState]:
        packet, player = send_delta(state.player, delta)
        if delta.is_empty:
            return Step(replace(state, player=player), packet, "empty")
        return Step(Stream3DGSState(player, frame, state.number), packet, "delta")
