"""What changed since the scene was last shown: on the device where the images are, in the processor's way elsewhere."""

from __future__ import annotations

import torch

from gsstream.core.frame import Frame
from gsstream.engine.fit.frame_images import FrameImages
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.active.change import Change, detect_changed_tiles
from gsstream.engine.step.active.change_on_device import change_on_device


def find_change(state: StreamState, frame: Frame, images: FrameImages, threshold: float) -> Change | None:
    """Return the changed tiles of every view, in the processor's memory; None where ``threshold`` is 0."""
    if threshold == 0 or images.device.type == "cpu":
        return detect_changed_tiles(state.previous, frame, threshold)
    resident = state.resident
    before = FrameImages(state.previous.images, images.device) if resident is None else resident.images
    tiles = [change_on_device(before[view], images[view], threshold) for view in range(len(images))]
    return Change(torch.stack(tiles).cpu(), frame.cameras.height, frame.cameras.width)
