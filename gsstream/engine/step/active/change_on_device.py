"""Which tiles changed, found on the device on which the images are: what ``change`` and ``blocks`` do, in torch."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import avg_pool2d, pad

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.engine.fit.frame_images import FrameImages
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.active.blocks import BLOCK, LEAST_SIGMA, MOST_OF_ROUGHNESS, MOST_SIGMA
from gsstream.engine.step.active.change import MIN_BLOCKS, Change, detect_changed_tiles
from gsstream.metrics.noise import MAD_TO_SIGMA
from gsstream.parts.render.images import TILE

#: Blocks along a side of a tile.
SIDE = TILE // BLOCK


def change_on_device(before: torch.Tensor, now: torch.Tensor, threshold: float) -> torch.Tensor:
    """Return [ceil(H / 16), ceil(W / 16)] bool: tiles of a view that changed between two images [H, W, 3]."""
    means, blocks = block_means(now - before)
    marked = (means.abs() > threshold * block_sigma(means)).any(-1)
    rows, columns = marked.shape
    down, across = -(-rows // SIDE), -(-columns // SIDE)
    inside = torch.stack([marked, blocks > 0]).float()
    both = avg_pool2d(pad(inside, (0, across * SIDE - columns, 0, down * SIDE - rows)), SIDE) * SIDE**2
    return both[0].round() >= both[1].round().clamp_max(MIN_BLOCKS)


def block_means(picture: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return means [h, w, 3] float64 of blocks of a picture [H, W, 3], and the number of pixels [h, w] of each."""
    height, width = picture.shape[:2]
    planes = pad(picture.permute(2, 0, 1), (0, -width % BLOCK, 0, -height % BLOCK)).double()
    sums = avg_pool2d(planes, BLOCK) * BLOCK**2
    sizes = [(side - torch.arange(0, side, BLOCK, device=picture.device)).clamp_max(BLOCK) for side in (height, width)]
    pixels = torch.outer(*sizes)
    return (sums / pixels).permute(1, 2, 0), pixels


def block_sigma(means: torch.Tensor) -> torch.Tensor:
    """Return []: the noise of block means of a difference, image units, within its bounds."""
    center = median(means)
    spread = MAD_TO_SIGMA * median((means - center).abs())
    seconds = [
        (side[:-2] - 2 * side[1:-1] + side[2:]).abs().flatten()
        for side in (means, means.transpose(0, 1))
        if len(side) > 2
    ]
    if seconds:
        # The variance of a - 2 b + c is six times that of each.
        admitted = MOST_OF_ROUGHNESS * MAD_TO_SIGMA * median(torch.cat(seconds)) / math.sqrt(6)
        spread = spread.minimum(admitted)
    return spread.clamp(LEAST_SIGMA, MOST_SIGMA)


def median(values: torch.Tensor) -> torch.Tensor:
    """Return []: the median; of an even number the mean of the two in the middle."""
    flat = values.flatten()
    low, high = (flat.kthvalue(place + 1).values for place in ((len(flat) - 1) // 2, len(flat) // 2))
    return (low + high) / 2


def votes_on_device(change: Change, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
    """Return [N]: what :meth:`Change.votes` does, for centres [N, 3] on the device of ``change``."""
    dilated = change.dilated.flatten(1)
    hits, seen = torch.zeros_like(means[:, 0]), torch.zeros_like(means[:, 0])
    columns = -(-change.width // TILE)
    for view in range(len(cameras)):
        # As numbers, which go along with every operation: a matrix would be copied to the device.
        pose, K = cameras.viewmats[view].astype("float32").tolist(), cameras.Ks[view].astype("float32").tolist()
        x, y, z = (row[0] * means[:, 0] + row[1] * means[:, 1] + row[2] * means[:, 2] + row[3] for row in pose[:3])
        inside = z > cameras.near_plane
        inverse = 1 / torch.where(inside, z, 1.0)
        u, v = K[0][0] * x * inverse + K[0][2], K[1][1] * y * inverse + K[1][2]
        inside = inside & (u >= 0) & (v >= 0) & (u < change.width) & (v < change.height)
        u, v = (torch.where(inside, of, 0.0) * (1 / TILE) for of in (u, v))
        seen = seen + inside
        hits = hits + (inside & dilated[view][v.long() * columns + u.long()])
    return hits / seen.clamp_min(1)


def find_change(state: StreamState, frame: Frame, images: FrameImages, threshold: float) -> Change | None:
    """Return the changed tiles of every view, in the processor's memory; None where ``threshold`` is 0."""
    if threshold == 0 or images.device.type == "cpu":
        return detect_changed_tiles(state.previous, frame, threshold)
    resident = state.resident
    before = FrameImages(state.previous.images, images.device) if resident is None else resident.images
    tiles = [change_on_device(before[view], images[view], threshold) for view in range(len(images))]
    return Change(torch.stack(tiles).cpu(), frame.cameras.height, frame.cameras.width)
