"""What the encoder carries from frame to frame. Everything a player cannot know is here; the rest is the player's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.state import rows
from gsstream.engine.fit.exposure import Exposure
from gsstream.method.base import Step as MethodStep
from gsstream.packet import PlayerState
from gsstream.render.base import RenderSession


@dataclass(frozen=True)
class StreamState:
    """Encoder state after a frame.

    Arguments:
        player: exactly what every player has after the last packet (decoded from its bytes).
        hierarchy: groups of the layout in ``player``.
        previous: training images of the last frame whose packet changed the scene: what the scene shows.
            Stored as the recipe says (``data.images``); read them through ``core.storage.unpacked``.
        decoders: linear decoders to continue from; equal to the player's once they were sent.
        exposure: colour maps of the training cameras, or None.
        key_frame: frame of the last key packet.
        key_quality: PSNR of that frame on the training views, dB; None when the recipe does not watch it.
        gate_moments: Adam moments of the gate logits when the recipe carries them over (released code), else empty.
        session: what the renderer keeps of this scene from one frame to the next. Nothing but time depends on it: a
            state without one (the first, a resumed one) goes on to the same bytes.
    """

    player: PlayerState
    hierarchy: Hierarchy = rows("gaussian")
    previous: Frame = rows(None)
    decoders: Mapping[str, torch.Tensor] = rows(None, default_factory=dict)
    exposure: Exposure | None = rows(None, default=None)
    key_frame: int = rows(None, default=0)
    key_quality: float | None = rows(None, default=None)
    gate_moments: Mapping[str, torch.Tensor] = rows("node", default_factory=dict)
    session: RenderSession | None = rows(None, default=None, compare=False, repr=False)

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        """The decoded scene as torch tensors that share the player's memory."""
        return self.player.gaussians.map(torch.from_numpy)


#: Outcome of one frame step of the five-part path.
Step = MethodStep[StreamState]
