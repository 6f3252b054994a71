"""What the encoder carries from frame to frame. Everything a player cannot know is here; the rest is the player's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.state.refinement import Refinement
from gsstream.engine.state.resident import Resident
from gsstream.method.base import Step as MethodStep
from gsstream.packet import PlayerState
from gsstream.parts.render.base import RenderSession
from gsstream.parts.render.exposure import Exposure


@dataclass(frozen=True)
class StreamState:
    """Encoder state after a frame."""

    player: PlayerState  # exactly what every player has after the last packet (decoded from its bytes)
    hierarchy: Hierarchy  # groups of the layout in ``player``
    #: Training images of the last frame whose packet changed the scene: what the scene shows. Stored as the recipe
    #: says (``data.images``).
    previous: Frame
    #: Linear decoders to continue from; equal to the player's once they were sent.
    decoders: Mapping[str, torch.Tensor] = field(default_factory=dict)
    exposure: Exposure | None = None  # colour maps of the training cameras, or None
    key_frame: int = 0  # frame of the last key packet
    #: The first frame as it goes on being optimised beside the stream; None before the frame after it, from the key
    #: packet on that brings it, and when the recipe asks for none.
    refinement: Refinement | None = None
    #: What the motion part remembers of the packets since the last key packet (``MotionPart.follow``).
    motion_memory: Any = None
    #: What the renderer keeps of this scene from one frame to the next. Nothing but time depends on it: a state
    #: without one (the first, a resumed one) goes on to the same bytes.
    session: RenderSession | None = field(default=None, compare=False, repr=False)
    #: The same scene and what it shows on the device of a renderer that works on a GPU; nothing but time depends on
    #: it, either.
    resident: Resident | None = field(default=None, compare=False, repr=False)

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        """The decoded scene as torch tensors that share the player's memory."""
        return self.player.gaussians.map(torch.from_numpy)


#: Outcome of one frame of a method made of parts.
Step = MethodStep[StreamState]
