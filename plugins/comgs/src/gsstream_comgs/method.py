"""ComGS (NeurIPS 2025) as a method of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
import torch

from gsstream.api import (
    Delta,
    Frame,
    Layout,
    PlayerState,
    Step,
    StreamingMethod,
    Tools,
    apply_motion,
    send_delta,
    send_key,
)
from gsstream.blocks import rows_in_changed_tiles
from gsstream_comgs.correction import corrected
from gsstream_comgs.motion import fitted_motion
from gsstream_comgs.settings import ComGSConfig


@dataclass(frozen=True)
class ComGSState:
    """``player``: what every player has. ``previous``: the images its scene shows."""

    player: PlayerState
    previous: Frame


@final
class ComGS(StreamingMethod[ComGSState]):
    """Moves Gaussians by a few key points and corrects them at key frames (ComGS, NeurIPS 2025).

    In every frame about two hundred Gaussians are key points, each with a rigid motion and an ellipsoid of influence.
    Every so many frames Gaussians in error are corrected behind a learned mask. What is sent are rigid motions of small
    cells, which come nearest to the field of the key points, and residuals. Where this differs from what is published,
    and why: README of this plugin.
    """

    source = "ComGS (NeurIPS 2025)"

    Config = ComGSConfig
    recipe_keys = ("stream.epochs",)

    def begin(self, frame: Frame, tools: Tools) -> Step[ComGSState]:
        first = tools.first_frame(frame)
        layout = Layout.flat(len(first.gaussians), frame.cameras.extent)
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(ComGSState(player, frame), packet, "key")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> ComGSState:
        return ComGSState(player, shown)

    def step(self, state: ComGSState, frame: Frame, tools: Tools) -> Step[ComGSState]:
        with tools.log.phase("motion"):
            still = np.array_equal(state.previous.images, frame.images)
            # At a key frame what is still wrong is corrected, whether something moves or not.
            key = frame.index % self.config.correction.every == 0
            if frame.effort == 0 or (still and not key):
                return self._send(state, frame, Delta())
            epochs, order = tools.epochs(frame), tools.rng.numpy("comgs", frame.index)
            scene, delta = state.player.scene, Delta()
            work = tools.open(state.player, state.previous, frame)
            settings, means = self.config.motion, work.gaussians.means
            rows = rows_in_changed_tiles(work.session, means, state.previous, frame, settings.change, settings.votes)
            motion = fitted_motion(scene, work, rows, epochs, self.config.motion, order) if len(rows) else None
            if motion is not None:
                delta = Delta((motion,))
                scene = apply_motion(scene, motion)[0]
        with tools.log.phase("optimise"):
            if key:
                passes = max(1, round(epochs * self.config.correction.passes))
                work = work.on(scene.gaussians.map(torch.from_numpy))  # what was rendered of the scene before goes
                residual = corrected(work, scene.layout, passes, self.config.correction, order)
                delta = delta.with_residual(residual)
        with tools.log.phase("code"):
            step = self._send(state, frame, delta)
        tools.log.set(corrected=key)
        return step

    def _send(self, state: ComGSState, frame: Frame, delta: Delta) -> Step[ComGSState]:
        packet, player = send_delta(state.player, delta)
        if delta.is_empty:
            return Step(replace(state, player=player), packet, "empty")
        return Step(ComGSState(player, frame), packet, "delta")
