"""Slow changes that no frame shows as a change: the pictures of what stands still, compared over many frames.

From one frame to the next the light of a room changes by less than the noise of its cameras, so no tile counts as
changed. Compared with the frame whose light the colours of the scene have, it adds up until it is seen.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.engine.fit.photometric import FrameImages
from gsstream.parts.render.images import TILE

#: Every so many frames the pictures are looked at, and of these every so many pixels each way, in two grids.
INTERVAL, STRIDE = 5, 4
#: Largest difference of a pixel, levels of 255, in a tile that stood still: noise and light, but nothing that moved.
STILL = 15.0
#: Share of the tiles that stood still which must have drifted, and share of all that must have stood still to tell.
DRIFTED, ENOUGH = 1 / 3, 1 / 4


class Lit(NamedTuple):
    """A frame whose light the colours of the scene have, and its pixels that are looked at.

    Arguments:
        frame: its index.
        pixels: [2, V, h, w, 3] of two grids that share no pixel, as they are stored.
    """

    frame: int
    pixels: torch.Tensor


class Drift(NamedTuple):
    """The frame that the next one is compared with, and whether the light has drifted away from that frame's."""

    lit: Lit | None
    is_due: bool


def looked_at(frame: int, images: FrameImages) -> Lit:
    """Return the pixels of a frame that are looked at."""
    grids = []
    for first in (STRIDE // 4, STRIDE // 4 + STRIDE // 2):
        views = []
        for picture in images.all_stored():
            height, width = (side // STRIDE * STRIDE for side in picture.shape[:2])
            views.append(picture[first:height:STRIDE, first:width:STRIDE])
        grids.append(torch.stack(views))
    return Lit(frame, torch.stack(grids))


def drift(lit: Lit | None, now: Lit, levels: float) -> Drift:
    """Compare the pixels of a frame with those of the frame whose light the colours have; None: with none, yet.

    Where too little has stood still to tell (a lamp was switched on), what comes next is compared with this frame.

    Arguments:
        levels: of 255, by which the mean colour of a tile must differ.
    """
    if lit is None:
        return Drift(now, False)
    still, drifted = tile_shares(lit, now, levels)
    if still < ENOUGH:
        return Drift(now, False)
    return Drift(lit, drifted > DRIFTED)


def tile_shares(before: Lit, now: Lit, levels: float) -> tuple[float, float]:
    """Return the share of the tiles that stood still, and of these the share whose mean colour differs by ``levels``.

    The square of a difference is estimated by the product of those of two grids of pixels, whose noise is independent,
    so that the noise of a camera need not be known: it adds nothing to the mean of the products.
    """
    whole = 255.0 if now.pixels.is_floating_point() else 1.0
    difference, side = (now.pixels.float() - before.pixels.float()) * whole, TILE // STRIDE
    height, width = (size // side for size in difference.shape[2:4])
    if height * width == 0:
        return 0.0, 0.0
    whole_tiles = difference[:, :, : height * side, : width * side]
    tiles = whole_tiles.reshape(2, -1, height, side, width, side, 3)
    still = (tiles.abs().amax((3, 5, 6)) <= STILL).all(0)
    one, other = tiles.mean((3, 5))
    drifted = ((one * other).mean(-1) > levels**2) & still
    return float(still.float().mean()), float(drifted.sum()) / max(int(still.sum()), 1)
