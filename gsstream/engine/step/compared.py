"""What a later frame is compared with, and what changed since.

A frame's passes carry most of a change, not all: of a leap about half. So a frame is compared with the pictures that
the scene shows, and with those that it showed before its last packet: what changed in the last frame is worked on once
more, though it may stand still by now. Nothing else would mend it there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from gsstream.core.changes import Delta
from gsstream.core.frame import Frame, packed_frame
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.photometric import FrameImages, MixedImages
from gsstream.engine.state.stream_state import Pictures, StreamState
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.change import Change


def looks_back(assembly: Assembly) -> bool:
    """Say whether a frame is compared with what the scene showed before the last packet, too.

    Where everything takes part in every frame there is nothing to work on longer.
    """
    return assembly.recipe.stream.change_threshold > 0


class Found(NamedTuple):
    """What changed, None for everything, and the images since which it did."""

    change: Change | None
    before: FrameImages


def find_change(renderer: Renderer, state: StreamState, images: FrameImages, threshold: float) -> Found:
    """Return what changed since the images that the scene shows or, in other tiles, since those that it showed before.

    Everything did where the threshold is 0.
    """
    shown, earlier = state.pictures_on(images.device)
    if threshold == 0:
        return Found(None, shown)
    now = images.all_stored()
    change = renderer.find_change(shown.all_stored(), now, threshold)
    if earlier is None:
        return Found(change, shown)
    tiles = renderer.find_change(earlier.all_stored(), now, threshold).tiles
    return Found(change.with_tiles(tiles), MixedImages(shown, earlier, tiles & ~change.tiles))


def shown_after(assembly: Assembly, state: StreamState, frame: Frame, delta: Delta, images: FrameImages) -> StreamState:
    """Return the state with the pictures that the scene shows after a frame, and those that it showed before.

    A frame that changed nothing, or the light alone, is not what the scene shows: the next one is compared with the
    last that did, so that a change too slow to see from frame to frame adds up until it is seen.
    """
    if delta.is_light_at_most:
        return state.settled
    earlier = state.previous if looks_back(assembly) and not state.lamps else None
    pictures = None
    if images.device.type != "cpu":
        pictures = Pictures(images, None if earlier is None else state.pictures_on(images.device).shown)
    return replace(state, previous=packed_frame(frame), earlier=earlier, lamps=(), pictures=pictures)
