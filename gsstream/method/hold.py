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
class HoldState:
    """Nothing but what the player has."""

    player: PlayerState


@final
class Hold(StreamingMethod[HoldState]):
    """Sends frame 0 and then 16 bytes a frame."""

    source = "gsstream"

    def begin(self, frame: Frame, tools: Tools) -> Step[HoldState]:
        first = tools.first_frame(frame)
        packet, player = send_key(first.gaussians, first.layout, first.meta, frame.index)
        return Step(HoldState(player), packet, "key")

    def step(self, state: HoldState, frame: Frame, tools: Tools) -> Step[HoldState]:
        packet, player = send_delta(state.player, Delta())
        return Step(HoldState(player), packet, "empty")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> HoldState:
        return HoldState(player)
