"""Slow changes that no frame shows as a change: the pictures of what stands still, compared over many frames.

From one frame to the next the light of a room changes by less than the noise of its cameras, so no tile counts as
changed. Compared with the frame whose light the colours of the scene have, it adds up until it is seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.photometric import FrameImages
from gsstream.parts.render.images import TILE

#: Every so many frames the pictures are looked at, and of these every so many pixels each way, in two grids that begin
#: at these.
EVERY, STRIDE = 5, 4
GRIDS = (STRIDE // 4, STRIDE // 4 + STRIDE // 2)
#: Largest difference of a pixel, levels of 255, in a tile that stood still: noise and light, but nothing that moved.
STILL = 15.0
#: Share of the tiles that stood still which must have drifted, and share of all that must have stood still to tell.
DRIFTED, ENOUGH = 1 / 3, 1 / 4
#: Correlation with the picture before from which a camera still shows the same.
ALIKE = 0.7


class Lit(NamedTuple):
    """A frame whose light the colours of the scene have, and its pixels that are looked at.

    Arguments:
        frame: its index.
        pixels: [2, V, h, w, 3] of two grids that share no pixel, as they are stored.
        gains: [V, 3] by which cameras had become brighter then; None: none had.
        lamps: [3] by which lamps that were switched since have made everything brighter.
    """

    frame: int
    pixels: torch.Tensor
    gains: FloatArray | None = None
    lamps: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def in_light(self, factor: tuple[float, float, float]) -> Lit:
        """Return what is known of the frame after a lamp was switched. Pixels are kept, so that a flash loses none."""
        red, green, blue = (had * more for had, more in zip(self.lamps, factor, strict=True))
        return self._replace(lamps=(red, green, blue))


class Drift(NamedTuple):
    """What changed slowly.

    Arguments:
        lit: the frame that the next one is compared with.
        is_due: whether the light has drifted away from that frame's.
        apart: cameras whose pictures have drifted as those of most cameras have not.
    """

    lit: Lit
    is_due: bool
    apart: tuple[int, ...] = ()


def looked_at(frame: int, images: FrameImages, gains: FloatArray | None) -> Lit:
    """Return the pixels of a frame that are looked at."""
    grids = []
    for first in GRIDS:
        views = []
        for picture in images.all_stored():
            height, width = (side // STRIDE * STRIDE for side in picture.shape[:2])
            views.append(picture[first:height:STRIDE, first:width:STRIDE])
        grids.append(torch.stack(views))
    return Lit(frame, torch.stack(grids), gains)


class Changes(NamedTuple):
    """Pixels [2, V, h, w, 3] as they were, levels of 255, and their change but for that of the cameras' gains."""

    first: torch.Tensor
    changed: torch.Tensor


def changes(before: Lit, now: Lit) -> Changes:
    """Compare the pixels of two frames."""
    device = now.pixels.device
    first, then = (
        lit.pixels.to(device).float() * (255.0 if lit.pixels.is_floating_point() else 1.0) for lit in (before, now)
    )
    if before.lamps != now.lamps:
        first = (first * first.new_tensor(before.lamps)).clamp_max(255.0)
    # Where no camera drifts, pictures are compared as they are stored, to the bit.
    if now.gains is not before.gains:
        one = np.ones((then.shape[1], 3), np.float32)
        was, became = (one if lit.gains is None else lit.gains for lit in (before, now))
        then = then * torch.from_numpy(was / became).to(then.device)[:, None, None]
    return Changes(first, then - first)


def drift(lit: Lit, now: Lit, levels: float) -> Drift:
    """Compare the pixels of a frame with those of the frame whose light the colours have.

    Where too little has stood still to tell (a lamp was switched on), what comes next is compared with this frame.

    Arguments:
        levels: of 255, by which the mean colour of a tile must differ.
    """
    found = changes(lit, now)
    still, drifted = tile_shares(found, levels)
    if still < ENOUGH:
        return Drift(now, False)
    return Drift(lit, drifted > DRIFTED, cameras_apart(found, levels))


def tile_shares(pixels: Changes, levels: float) -> tuple[float, float]:
    """Return the share of the tiles that stood still, and of these the share whose mean colour differs by ``levels``.

    The square of a difference is estimated by the product of those of two grids of pixels, whose noise is independent,
    so that the noise of a camera need not be known: it adds nothing to the mean of the products.
    """
    tiles = _tiles(pixels.changed)
    if tiles.numel() == 0:
        return 0.0, 0.0
    still = (tiles.abs().amax((3, 5, 6)) <= STILL).all(0)
    one, other = tiles.mean((3, 5))
    drifted = ((one * other).mean(-1) > levels**2) & still
    return float(still.float().mean()), float(drifted.sum()) / max(int(still.sum()), 1)


def cameras_apart(pixels: Changes, levels: float) -> tuple[int, ...]:
    """Return the cameras that got brighter or darker by ``levels`` more than most, in a channel, in most of a picture.

    A camera that shows something else than before (somebody stands before it, or it went black) is not among them. Of
    two cameras neither is most. Light that falls on what one of them sees alone is not told apart from its drift here,
    but by :mod:`gsstream.engine.step.gains`.
    """
    first = pixels.first
    if first.shape[1] < 3:
        return ()
    level = first.mean((0, 2, 3)).clamp_min(1.0)
    ratio = ratio_in_most(pixels)
    apart = ((ratio - ratio.quantile(0.5, 0)) * level).abs().amax(1) > levels
    if not apart.any():
        return ()
    return tuple((apart & (_likeness(first, first + pixels.changed) > ALIKE)).nonzero()[:, 0].tolist())


def ratio_in_most(pixels: Changes) -> torch.Tensor:
    """Return [V, 3]: by which share of its brightness each camera's picture changed in the median of its tiles."""
    bright, change = (_tiles(values).mean((0, 3, 5)).flatten(1, 2) for values in pixels)
    if bright.shape[1] == 0:
        return bright.new_zeros(len(bright), 3)
    return (change / bright.clamp_min(1.0)).quantile(0.5, 1)


def _likeness(first: torch.Tensor, then: torch.Tensor) -> torch.Tensor:
    """Return [V] correlations of the brightness of pixels; 0 where all are as bright."""
    pixels = (values.mean(4).transpose(0, 1).flatten(1) for values in (first, then))
    one, other = (values - values.mean(1, keepdim=True) for values in pixels)
    return (one * other).sum(1) / (one.square().sum(1) * other.square().sum(1)).sqrt().clamp_min(1e-3)


def _tiles(values: torch.Tensor) -> torch.Tensor:
    """[2, V, h, w, 3] as tiles [2, V, h / s, s, w / s, s, 3]; what is left beside whole tiles is dropped."""
    side = TILE // STRIDE
    height, width = (size // side for size in values.shape[2:4])
    whole = values[:, :, : height * side, : width * side]
    return whole.reshape(2, values.shape[1], height, side, width, side, 3)
