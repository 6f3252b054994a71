"""The state that a frame step is timed from."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.engine.state.stream_state import StreamState


def mid_stream_state(parts: Assembly, state: StreamState, last: EncodedFrame | None) -> StreamState:
    """Return ``state`` in the middle of a stream: its session has the caches that a step of this variant fills.

    A step hands its session's caches on to the next scene, so each repetition needs them anew.
    """
    left = None if last is None else last.state.session
    if left is None:
        return state
    rig = state.previous.cameras
    session = parts.renderer.open(state.gaussians, None, rig, parts.background)
    nothing = torch.zeros(rig.height, rig.width, 3)
    for view in left.cache_bytes().per_view:
        session.screen_gradient(view, nothing)
    return replace(state, session=session)
