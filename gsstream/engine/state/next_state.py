"""What the encoder carries over a packet: rows, nodes and decoders follow what players decode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.changes import AddedGaussians, Layout
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.state.stream_state import StreamState
from gsstream.packet import PlayerState
from gsstream.parts.motion.base import MotionPart


def next_state(motion: MotionPart, state: StreamState, player: PlayerState, rng: Rng) -> StreamState:
    """Return ``state`` after the packet that led to ``player`` (decoded, no key packet).

    A resumed run calls this for every packet it replays, so it depends on nothing but the packet.
    """
    decoders = {**state.decoders, **{name: torch.from_numpy(value) for name, value in player.decoders.items()}}
    after = replace(state, player=player, decoders=decoders)
    if player.delta is None or player.before is None:
        return after
    memory = motion.follow(state.motion_memory, player.frame, player.before, player.delta, rng)
    after = replace(after, motion_memory=memory)
    if not player.delta.has_row_edit:
        return after
    return replace(after, hierarchy=next_hierarchy(state.hierarchy, player.delta.added, player.layout))


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
