"""HiCoM (Gao et al., NeurIPS 2024) as a method of its own."""

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
    send_delta,
    send_key,
)
from gsstream.blocks import replace_with_copies, rows_in_changed_tiles
from gsstream_hicom.motion import fitted_motions
from gsstream_hicom.settings import HiCoMConfig


@dataclass(frozen=True)
class HiCoMState:
    """``player``: what every player has. ``previous``: the images its scene shows. ``number``: that of Gaussians kept.
    """

    player: PlayerState
    previous: Frame
    number: int


@final
class HiCoM(StreamingMethod[HiCoMState]):
    """Moves the cells of nested grids rigidly and adds Gaussians (paper: Gao et al., NeurIPS 2024).

    Half of a frame's passes fit the motion, from the coarsest grid to the finest; the other half fits Gaussians that
    are copied where the images pull at the scene. In the next frame as many of the least opaque leave, so the number
    stays that of frame 0. What is sent are motions, births and deaths: attributes of what is there never change.
    Where this differs from what is published, and why: README of this plugin.
    """

    source = "HiCoM (Gao et al. 2024)"

    Config = HiCoMConfig
    recipe_keys = ("stream.epochs",)

    def begin(self, frame: Frame, tools: Tools) -> Step[HiCoMState]:
        first = tools.first_frame(frame)
        number = len(first.gaussians)
        layout = Layout.flat(number, frame.cameras.extent)
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(HiCoMState(player, frame, number), packet, "key")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> HiCoMState:
        return HiCoMState(player, shown, len(next(tools.since_key()).gaussians))

    def step(self, state: HiCoMState, frame: Frame, tools: Tools) -> Step[HiCoMState]:
        with tools.log.phase("motion"):
            if frame.effort == 0 or np.array_equal(state.previous.images, frame.images):
                return self._send(state, frame, Delta())
            epochs = tools.epochs(frame)
            for_births = max(1, round(self.config.births.share * epochs)) if self.config.births.share else 0
            scene = state.player.scene
            work = tools.open(state.player, state.previous, frame)
            settings, means = self.config.motion, work.gaussians.means
            rows = rows_in_changed_tiles(work.session, means, state.previous, frame, settings.change, settings.votes)
            order = tools.rng.numpy("hicom", frame.index)
            motions, moved = fitted_motions(
                scene, work, rows, max(1, epochs - for_births), self.config.motion, order
            )
            work = work.on(moved.gaussians.map(torch.from_numpy))  # what was rendered of the scene before goes
        with tools.log.phase("growth"):
            change = self._rows(moved, state.number, work, for_births, tools) if for_births else RowEdit()
        with tools.log.phase("code"):
            step = self._send(state, frame, Delta(motions).with_row_edit(change))
        tools.log.set(iterations=epochs * len(frame.cameras))
        return step

    def _rows(self, scene: Scene, number: int, work: FrameTools, epochs: int, tools: Tools) -> RowEdit:
        """As many of the least opaque leave as there are more than in frame 0; then this frame's are born."""
        deaths = np.sort(np.argsort(scene.gaussians.opacities, kind="stable")[: len(scene.gaussians) - number])
        births = self.config.births
        return replace_with_copies(
            scene, deaths, work, epochs, tools.rng, gradient=births.gradient, most=births.most, rounds=births.rounds,
            prune_opacity=births.prune_opacity,
        )  # fmt: skip

    def _send(self, state: HiCoMState, frame: Frame, delta: Delta) -> Step[HiCoMState]:
        packet, player = send_delta(state.player, delta)
        if delta.is_empty:
            return Step(replace(state, player=player), packet, "empty")
        return Step(HiCoMState(player, frame, state.number), packet, "delta")
