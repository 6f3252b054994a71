"""Which Gaussian is which, from one frame of a stream to a later one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gsstream.core.changes import gather_rows
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet import PacketKind, PlayerState
from gsstream.player.playback import Playback


def track_rows(source: IntArray, state: PlayerState) -> IntArray:
    """Return [N'] int64: which row of the key packet each row is after the packet that led to ``state``; -1 is none."""
    if state.delta is None or not state.delta.has_row_edit:
        return source
    assert state.before is not None
    added = state.delta.added
    gathered = gather_rows(state.before.node_of, added, state.delta.removed)
    none = np.full(0 if added is None else len(added), -1, np.int64)
    return np.concatenate([source, none])[gathered]


def tracked(playback: Playback, frames: Sequence[int]) -> Iterator[tuple[int, Gaussians[FloatArray], IntArray]]:
    """Yield frame, scene and [N] int64: which row of the frame yielded before each row was; -1 is none.

    ``frames`` are in order of time. All rows of a key packet are new.
    """
    before: int | None = None
    source: IntArray = np.empty(0, np.int64)
    for frame in frames:
        for step in range(frame if before is None else before + 1, frame + 1):
            state = playback.player_state(step)
            is_new = before is None or playback.entry(step).kind == PacketKind.KEY
            source = np.full(len(state.gaussians), -1, np.int64) if is_new else track_rows(source, state)
        yield frame, state.gaussians, source
        before, source = frame, np.arange(len(state.gaussians))
