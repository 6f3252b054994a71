"""A method that follows the light: one colour shift a frame for the whole scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    Delta,
    Frame,
    PartConfig,
    PlayerState,
    Residual,
    Step,
    StreamingMethod,
    Tools,
    send_delta,
    send_key,
)

#: Colour of one unit of the degree-0 spherical-harmonic coefficient.
SH0 = 0.2820948


@dataclass(frozen=True)
class Carried:
    """State from frame to frame; here only the state of every player."""

    player: PlayerState


@final
class ExampleMethod(StreamingMethod[Carried]):
    """Adds the mean colour difference between the cameras and the scene to every Gaussian."""

    source = "gsstream"

    class Config(PartConfig):
        step: float = Field(default=0.02, gt=0, le=1, description="quantisation step of the shift, sh0 units, to 1")

    def begin(self, frame: Frame, tools: Tools) -> Step[Carried]:
        first = tools.first_frame(frame)
        # One node holds all Gaussians: one gate, and the same symbols in every row cost next to nothing.
        layout = replace(first.layout, node_counts=np.array([len(first.gaussians)], np.int32))
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(Carried(player), packet, "key")

    def step(self, state: Carried, frame: Frame, tools: Tools) -> Step[Carried]:
        work = tools.open(state.player, frame, frame)
        views = range(len(frame.cameras))
        shift = torch.stack([(work.image(v) - work.previous_render(v)).mean((0, 1)) for v in views]).mean(0) / SH0
        symbols = torch.round(shift / self.config.step).to(torch.int32).numpy()
        if frame.epoch_scale == 0 or not symbols.any():
            packet, player = send_delta(state.player, Delta())
            return Step(Carried(player), packet, "empty")
        rows = np.tile(symbols, (len(state.player.gaussians), 1))
        residual = Residual(np.ones(1, np.uint8), 1, {"sh0": rows}, {"sh0": self.config.step})
        packet, player = send_delta(state.player, Delta((residual,)))
        return Step(Carried(player), packet, "delta")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Carried:
        return Carried(player)
