"""What the encoder carries from frame to frame. Everything a player cannot know is here; the rest is the player's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from gsstream.core.changes import AddedGaussians, Layout, Light
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.engine.fit.densify import DensifyStatistics
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.colour_maps import exposure_with, first_exposure
from gsstream.engine.state.drift import Lit
from gsstream.input.seeds.shell import Shell
from gsstream.method.base import Step as MethodStep
from gsstream.packet import PlayerState
from gsstream.parts.motion.base import MotionPart
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.session import RenderSession


@dataclass(frozen=True)
class Refinement:
    """All Gaussians of a scene in training, which no player has yet. Nothing in it is changed once it is made.

    It follows from the first key packet, the packets since and their pictures, so a resumed run makes it again.
    """

    gaussians: Gaussians[torch.Tensor]  # [B] rows, raw values
    levels: torch.Tensor  # [B] int64 octree level of each
    ancestors: torch.Tensor  # [B] int64 row of the players' scene that each came from; -1: that one is gone
    #: Attribute -> Adam state of its rows (``RowParameters.moments``); empty before the first iteration.
    moments: Mapping[str, Mapping[str, torch.Tensor]]
    statistics: DensifyStatistics  # of the screen gradients since Gaussians were last added
    iterations: int  # made so far
    pace: int  # iterations that the next frame of a live recording may make


class Resident(NamedTuple):
    """The decoded scene and its groups on the renderer's device."""

    gaussians: Gaussians[torch.Tensor]
    hierarchy: Hierarchy


class Pictures(NamedTuple):
    """The images that the decoded scene shows, and those that it showed before its last packet, on a device."""

    shown: FrameImages
    earlier: FrameImages | None = None


def updated(before: Gaussians[torch.Tensor], after: Gaussians[FloatArray], rows: IntArray) -> Gaussians[torch.Tensor]:
    """Return the scene ``after`` on the device of ``before``; only ``rows`` [A], all that differ, are copied to it."""
    device = before.means.device
    if device.type == "cpu":
        return after.map(torch.from_numpy)
    index = torch.from_numpy(rows).to(device)
    changed = after.rows(rows).map(lambda value: torch.from_numpy(value).to(device))
    return Gaussians(**{name: value.index_copy(0, index, getattr(changed, name)) for name, value in before.items()})


@dataclass(frozen=True)
class StreamState:
    """Encoder state after a frame."""

    player: PlayerState  # exactly what every player has after the last packet (decoded from its bytes)
    hierarchy: Hierarchy  # groups of the layout in ``player``
    #: Training images of the last frame whose packet changed the scene: what the scene shows. As bytes
    #: where bytes hold them.
    previous: Frame
    #: Linear decoders to continue from; equal to the player's once they were sent.
    decoders: Mapping[str, torch.Tensor] = field(default_factory=dict)
    exposure: Exposure | None = None  # colour maps of the training cameras, or None
    #: [C, 3] by which each camera has become brighter since the first frame; None: none drifts alone.
    gains: FloatArray | None = None
    key_frame: int = 0  # frame of the last key packet
    shell: Shell | None = None  # the sphere behind the scene; None: the recipe asks for none
    #: The first frame as it goes on being optimised beside the stream; None from the key packet on that brings it, and
    #: when the recipe asks for none.
    refinement: Refinement | None = None
    #: State of the motion part after the packets since the last key packet (``MotionPart.follow``).
    motion_memory: Any = None
    #: Training images that the scene showed before the last packet, if that changed it. The next frame is compared
    #: with these, too, so that what changed is worked on once more. None: with ``previous`` alone.
    earlier: Frame | None = None
    #: Lamps that were switched since ``previous``, in whose light it is.
    lamps: tuple[Light, ...] = ()
    #: The frame whose light the colours of what stands still have; None before the first that was looked at.
    lit: Lit | None = field(default=None, compare=False, repr=False)
    #: What the renderer keeps of this scene from one frame to the next. Nothing but time depends on it: a state
    #: without one (the first, a resumed one) goes on to the same bytes.
    session: RenderSession | None = field(default=None, compare=False, repr=False)
    #: The same scene, and ``previous`` and ``earlier``, on the device of a renderer that works on a GPU; nothing but
    #: time depends on them, either.
    resident: Resident | None = field(default=None, compare=False, repr=False)
    pictures: Pictures | None = field(default=None, compare=False, repr=False)

    def pictures_on(self, device: torch.device) -> Pictures:
        """Return the images that the next frame is compared with, on a device."""
        if self.pictures is not None:
            return self.pictures
        earlier = None if self.earlier is None else FrameImages(self.earlier.images, device)
        return Pictures(FrameImages(self.previous.images, device), earlier)

    @property
    def settled(self) -> StreamState:
        """The state whose next frame is compared with what the scene shows, and with nothing before that."""
        there = self.pictures
        return replace(self, earlier=None, pictures=None if there is None else Pictures(there.shown))

    def with_gains(self, gains: FloatArray) -> StreamState:
        """Return the state with cameras that have become brighter by these gains [C, 3] since the first frame."""
        return replace(self, gains=gains, exposure=exposure_with(first_exposure(self.player.meta), gains))

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        """The decoded scene as torch tensors that share the player's memory."""
        return self.player.gaussians.map(torch.from_numpy)


#: Outcome of one frame of a method made of parts.
Step = MethodStep[StreamState]


def next_state(motion: MotionPart, state: StreamState, player: PlayerState, rng: Rng) -> StreamState:
    """Return ``state`` after the packet that led to ``player`` (decoded, no key packet).

    A resumed run calls this for every packet it replays, so it depends on nothing but the packet.
    """
    # What the light brought is not the residual's: a row more of a decoder (``engine.step.light``).
    own = {n: torch.from_numpy(v[: len(state.decoders.get(n, v))]) for n, v in player.decoders.items()}
    after = replace(state, player=player, decoders={**state.decoders, **own})
    delta, before = player.delta, player.before
    if delta is None or before is None:
        return after
    if delta.has_row_edit:
        after = replace(after, hierarchy=next_hierarchy(state.hierarchy, delta.added, player.layout))
    return replace(after, motion_memory=motion.follow(state.motion_memory, player.frame, before, delta, rng))


def next_hierarchy(hierarchy: Hierarchy, added: AddedGaussians | None, layout: Layout) -> Hierarchy:
    """Return the forest after Gaussians were added and removed. Old nodes stay, also empty ones."""
    parents, levels = hierarchy.parent, hierarchy.level
    if added is not None and len(added.parents):
        parents = torch.cat([parents, torch.from_numpy(added.parents.astype(np.int64))])
        known = levels.tolist()
        for node, parent in enumerate(added.parents.tolist(), len(known)):
            known.append(0 if parent == node else known[parent] + 1)
        levels = torch.tensor(known, dtype=levels.dtype)
    return Hierarchy(torch.from_numpy(layout.node_of), parents, levels)
