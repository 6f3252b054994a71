"""Hold: frame 0, and nothing after it. The simplest method, and the floor that every other must beat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from gsstream.core.changes import Delta
from gsstream.core.frame import Frame
from gsstream.method.base import Step, StreamingMethod
from gsstream.method.packets import send_delta, send_key
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState


@dataclass(frozen=True)
class StaticState:
    """The state of the player, and nothing else."""

    player: PlayerState


@final
class Hold(StreamingMethod[StaticState]):
    """Sends frame 0 and then 16 bytes a frame."""

    source = "gsstream"

    def begin(self, frame: Frame, tools: Tools) -> Step[StaticState]:
        first = tools.first_frame(frame)
        packet, player = send_key(first.gaussians, first.layout, first.meta, frame.index)
        return Step(StaticState(player), packet, "key")

    def step(self, state: StaticState, frame: Frame, tools: Tools) -> Step[StaticState]:
        packet, player = send_delta(state.player, Delta())
        return Step(StaticState(player), packet, "empty")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> StaticState:
        return StaticState(player)
