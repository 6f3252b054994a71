"""What the encoder carries over a packet that adds or removes Gaussians: every row-aligned piece follows the packet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.births import gather_rows
from gsstream.core.delta import Delta, Layout
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.topology import TopologyEdit
from gsstream.engine.state.stream_state import StreamState
from gsstream.packet import PlayerState


def follow(state: StreamState, player: PlayerState) -> StreamState:
    """``state`` after the packet that led to ``player`` (decoded, no key packet): rows, nodes and decoders follow.

    A resumed run calls this for every packet it replays, so it depends on nothing but the packet.
    """
    decoders = {**state.decoders, **{name: torch.from_numpy(value) for name, value in player.decoders.items()}}
    after = replace(state, player=player, decoders=decoders)
    if player.delta is None or not player.delta.edits_rows:
        return after
    hierarchy = next_hierarchy(state.hierarchy, player.delta, player.layout)
    moments = {n: next_moments(value, hierarchy.num_nodes) for n, value in state.gate_moments.items()}
    return replace(after, hierarchy=hierarchy, gate_moments=moments)


def next_hierarchy(hierarchy: Hierarchy, delta: Delta, layout: Layout) -> Hierarchy:
    """The forest after a delta's births and deaths; ``layout`` is that after it. Old nodes stay, also empty ones."""
    parents, levels = hierarchy.parent, hierarchy.level
    if delta.births is not None and len(delta.births.parents):
        parents = torch.cat([parents, torch.from_numpy(delta.births.parents.astype(np.int64))])
        known = levels.tolist()
        for node, parent in enumerate(delta.births.parents.tolist(), len(known)):
            known.append(0 if parent == node else known[parent] + 1)
        levels = torch.tensor(known, dtype=levels.dtype)
    return Hierarchy(torch.from_numpy(layout.node_of), parents, levels)


def next_moments(value: torch.Tensor, num_nodes: int) -> torch.Tensor:
    """One Adam moment, or the steps taken, of every gate: zero for new nodes."""
    return torch.cat([value, value.new_zeros(num_nodes - len(value), *value.shape[1:])])


def edit_of(layout: Layout, delta: Delta) -> TopologyEdit:
    """The delta's births and deaths as an edit of per-Gaussian state; ``layout`` is that before it.

    A birth has no old row: it is fresh and points at the row that stays before it (else the first), and the caller
    replaces its values. The scene before must have a row.
    """
    source = gather_rows(layout.node_of, delta.births, delta.deaths)
    fresh = source >= len(layout.octree_levels)
    place = np.maximum.accumulate(np.where(fresh, 0, np.arange(len(source))))
    rows = np.where(fresh, np.where(fresh[place], 0, source[place]), source)
    return TopologyEdit(torch.from_numpy(rows), torch.from_numpy(fresh))
