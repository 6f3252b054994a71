"""ReCon-GS (NeurIPS 2025) as a method of its own, and what a method that is built on it shares with it."""

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
    apply_motion,
    send_delta,
    send_key,
)
from gsstream.blocks import CopyFilter, replace_with_copies, rows_in_changed_tiles
from gsstream_recon.anchors import AnchorLevels, anchors_after, due, followed
from gsstream_recon.motion import fitted_motion
from gsstream_recon.settings import ReConConfig


@dataclass(frozen=True)
class ReConState:
    """``player``: what every player has. ``previous``: the images its scene shows. ``number``: that of Gaussians kept.
    ``anchors``: of the last frame that changed something, as rows of the scene after it; None at first.
    """

    player: PlayerState
    previous: Frame
    number: int
    anchors: AnchorLevels | None = None


class AnchoredMethod(StreamingMethod[ReConState]):
    """Moves Gaussians by anchors on several levels, then adds some at constant number."""

    recipe_keys = ("stream.epochs",)
    Config = ReConConfig

    def begin(self, frame: Frame, tools: Tools) -> Step[ReConState]:
        first = tools.first_frame(frame)
        number = len(first.gaussians)
        layout = Layout.flat(number, frame.cameras.extent)
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(ReConState(player, frame, number), packet, "key")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> ReConState:
        anchors = anchors_after(tools.since_key(), self.config.motion, tools.rng)
        return ReConState(player, shown, len(next(tools.since_key()).gaussians), anchors)

    def step(self, state: ReConState, frame: Frame, tools: Tools) -> Step[ReConState]:
        with tools.log.phase("motion"):
            if frame.effort == 0 or np.array_equal(state.previous.images, frame.images):
                return self._send(state, frame, Delta(), state.anchors)
            epochs = tools.epochs(frame)
            for_births = max(1, round(self.config.births.share * epochs)) if self.config.births.share else 0
            scene, settings = state.player.scene, self.config.motion
            work = tools.open(state.player, state.previous, frame)
            means = work.gaussians.means
            rows = rows_in_changed_tiles(work.session, means, state.previous, frame, settings.change, settings.votes)
            anchors = due(state.anchors, frame.index, len(scene.gaussians), settings, tools.rng)
            motion = fitted_motion(
                scene, work, rows, (state.anchors, anchors), max(1, epochs - for_births), settings,
                tools.rng.numpy("recon", frame.index),
            )  # fmt: skip
            moved = scene if motion is None else apply_motion(scene, motion)[0]
            work = work.on(moved.gaussians.map(torch.from_numpy))  # what was rendered of the scene before goes
        with tools.log.phase("growth"):
            change = self._rows(moved, state.number, work, for_births, tools) if for_births else RowEdit()
        with tools.log.phase("code"):
            step = self._send(state, frame, Delta(() if motion is None else (motion,)).with_row_edit(change), anchors)
        tools.log.set(iterations=epochs * len(frame.cameras), anchors=[len(level) for level in anchors.rows])
        return step

    def _rows(self, scene: Scene, number: int, work: FrameTools, epochs: int, tools: Tools) -> RowEdit:
        """As many of the least opaque leave as there are more than in frame 0; then this frame's are born."""
        deaths = np.sort(np.argsort(scene.gaussians.opacities, kind="stable")[: len(scene.gaussians) - number])
        births = self.config.births
        return replace_with_copies(
            scene, deaths, work, epochs, tools.rng, gradient=births.gradient, most=births.most, rounds=births.rounds,
            prune_opacity=births.prune_opacity, admitted=self.admission(number),
        )  # fmt: skip

    def admission(self, kept: int) -> CopyFilter | None:
        """Return what chooses which Gaussians with a large gradient may be copied; None, as here: all of them."""
        return None

    def _send(
        self, state: ReConState, frame: Frame, delta: Delta, anchors: AnchorLevels | None
    ) -> Step[ReConState]:
        packet, player = send_delta(state.player, delta)
        if delta.is_empty or anchors is None:
            return Step(replace(state, player=player), packet, "empty")
        return Step(ReConState(player, frame, state.number, followed(anchors, player)), packet, "delta")


@final
class ReCon(AnchoredMethod):
    """Moves Gaussians by anchors drawn among them on three levels, and adds some (ReCon-GS, NeurIPS 2025).

    Half of a frame's passes fit the motions of anchors; the other half fits Gaussians that are copied where the
    gradient is large. In the next frame as many of the least opaque leave, so the number stays that of frame 0. Anchors
    are drawn anew every second frame and inherit what the old ones knew. What is sent are rigid motions of small cells,
    each the sum of its anchors' motions, births and deaths: attributes of what is there never change.
    Where this differs from what is published, and why: README of this plugin.
    """

    source = "ReCon-GS (NeurIPS 2025)"
