"""Which tiles of which views changed between two frames, beyond the measured noise of their camera; in torch.

Differences are averaged over small blocks of pixels, in which noise averages out and a change does not. Every other
body finds the same tiles, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import torch
from torch.nn.functional import max_pool2d, pad

from gsstream.core.cameras import Cameras
from gsstream.core.median import tensor_median
from gsstream.metrics.noise import MAD_TO_SIGMA
from gsstream.parts.render.images import TILE, float_image, spread_to_pixels
from gsstream.parts.render.session import RenderSession


class ChangeRule:
    """The numbers by which a change is told from noise.

    Arguments:
        BLOCK: side of a block, pixels. Noise of neighbouring pixels is mostly independent and averages out (rendered
            noise is heavy-tailed, so a threshold on single pixels finds it everywhere), motion does not.
        MIN_BLOCKS: blocks of a 16 x 16 tile (of 16) that must exceed the threshold.
        LEAST_SIGMA: lower bound on the estimated noise of a block's mean difference. Compressed video repeats still
            blocks exactly; without a floor the change of half a grey level by the encoder would count as motion.
        MOST_SIGMA: upper bound on the same estimate. The estimate holds while fewer than half of the blocks move; a
            flash or a cut moves all of them, and then the change itself would pass for noise and nothing would be seen
            to change. Recordings have about 1 / 255.
        MOST_OF_ROUGHNESS: upper bound on the same estimate, in multiples of the differences between neighbouring
            blocks. Noise differs from block to block, a slow change of the light hardly does: at a gain of 1.03 the
            spread of the differences doubles, their second differences grow by 5 %. Without such a change the first is
            at most 1.2 times the second on the recordings at hand.
        MAD_TO_SIGMA: standard deviation of a normal variable over its median absolute deviation.
    """

    BLOCK: Final = 4
    MIN_BLOCKS: Final = 2
    LEAST_SIGMA: Final = 0.5 / 255
    MOST_SIGMA: Final = 4 / 255
    MOST_OF_ROUGHNESS: Final = 1.5
    MAD_TO_SIGMA: Final = MAD_TO_SIGMA


@dataclass(frozen=True)
class Change:
    """Changed tiles per view, and what follows from them.

    Arguments:
        tiles: [V, ceil(H / 16), ceil(W / 16)] bool, where the renderer works.
        height, width: of the images, pixels.
    """

    tiles: torch.Tensor
    height: int
    width: int

    @cached_property  # it is the one number that a GPU is waited for
    def per_view(self) -> list[int]:
        """Number of changed tiles of each view."""
        return list(self.tiles.flatten(1).sum(1).cpu().tolist())

    @property
    def share(self) -> float:
        """Share of changed tiles over all views."""
        return sum(self.per_view) / max(self.tiles.numel(), 1)

    @cached_property  # every iteration asks for it
    def dilated(self) -> torch.Tensor:
        """[V, ceil(H / 16), ceil(W / 16)] bool: tiles that changed, and those beside one that did."""
        return max_pool2d(self.tiles[:, None].float(), 3, 1, 1)[:, 0] > 0

    def only_changed(self, view: int, values: torch.Tensor) -> torch.Tensor:
        """Return the values [H, W, 3] of this view's changed tiles, and 0 in the others."""
        return values * spread_to_pixels(self.tiles[view], self.height, self.width)[..., None]

    def difference(self, view: int, now: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """Return ``now - before`` [H, W, 3] in this view's changed tiles, and 0 in the others.

        Arguments:
            view: index of the camera.
            now, before: [H, W, 3] float32, or uint8 of which 255 is 1.0.
        """
        return self.only_changed(view, float_image(now) - float_image(before))

    def votes(self, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
        """Return [N]: share of the views a centre projects into in which its tile, or one beside it, has changed.

        Arguments:
            means: [N, 3] centres. A centre that projects into no view gets 0.
            cameras: those of the views.
        """
        dilated = self.dilated.flatten(1)
        hits, seen = torch.zeros_like(means[:, 0]), torch.zeros_like(means[:, 0])
        columns = -(-self.width // TILE)
        for view in range(len(cameras)):
            # As numbers, which go along with every operation: a matrix would be copied to the device.
            pose, K = cameras.viewmats[view].astype("float32").tolist(), cameras.Ks[view].astype("float32").tolist()
            x, y, z = (row[0] * means[:, 0] + row[1] * means[:, 1] + row[2] * means[:, 2] + row[3] for row in pose[:3])
            inside = z > cameras.near_plane
            inverse = 1 / torch.where(inside, z, 1.0)
            u, v = K[0][0] * x * inverse + K[0][2], K[1][1] * y * inverse + K[1][2]
            inside = inside & (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
            u, v = (torch.where(inside, of, 0.0) * (1 / TILE) for of in (u, v))
            seen = seen + inside
            hits = hits + (inside & dilated[view][v.long() * columns + u.long()])
        return hits / seen.clamp_min(1)

    def rows(self, means: torch.Tensor, cameras: Cameras, session: RenderSession, min_votes: float) -> torch.Tensor:
        """Return [N] bool: Gaussians that are drawn in a changed tile and have at least this share of votes.

        Arguments:
            means: [N, 3] centres of the session's scene.
            cameras: those of the views.
            session: asked who is drawn in which tiles.
            min_votes: 0 to 1.
        """
        if self.share == 0:
            return torch.zeros_like(means[:, 0], dtype=torch.bool)
        return session.visible_anywhere(self.tiles) & (self.votes(means, cameras) >= min_votes)


def find_change(before: Sequence[torch.Tensor], now: Sequence[torch.Tensor], threshold: float) -> Change:
    """Compare two frames view by view.

    Arguments:
        before, now: one image [H, W, 3] per view, float32, or uint8 of which 255 is 1.0.
        threshold: multiple of the noise of block means.
    """
    blocks = [changed_blocks(*pair, threshold) for pair in zip(before, now, strict=True)]
    height, width = now[0].shape[:2]
    return Change(changed_tiles(torch.stack(blocks)), height, width)


def changed_blocks(before: torch.Tensor, now: torch.Tensor, threshold: float) -> torch.Tensor:
    """Return [ceil(H / 4), ceil(W / 4)] bool: blocks whose mean difference exceeds the noise of block means."""
    means = block_means(_difference(before, now))
    return (means.abs() > threshold * block_sigma(means)).any(-1)


def _difference(before: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
    """[H, W, 3] float32, or int16 in levels of 8 bits where both images are stored as bytes."""
    if before.dtype == now.dtype == torch.uint8:
        return now.short() - before.short()
    return float_image(now) - float_image(before)


def block_means(picture: torch.Tensor) -> torch.Tensor:
    """Return [ceil(H / 4), ceil(W / 4), 3] float64 means of [H, W, 3]; border blocks average the pixels they have.

    Of int16 the sums are exact (they stay below 2^12), and a level is 1 / 255.
    """
    sums = _sums(_sums(picture).transpose(0, 1)).transpose(0, 1).double()
    if picture.dtype == torch.int16:
        sums = sums / 255.0
    sizes = [
        (side - torch.arange(0, side, ChangeRule.BLOCK, device=picture.device)).clamp_max(ChangeRule.BLOCK)
        for side in picture.shape[:2]
    ]
    return sums / torch.outer(*sizes)[..., None]


def _sums(rows: torch.Tensor) -> torch.Tensor:
    """Sums over BLOCK rows each, always added in this order; the last block may have fewer."""
    whole = len(rows) // ChangeRule.BLOCK * ChangeRule.BLOCK
    first, second, third, fourth = (rows[i : whole : ChangeRule.BLOCK] for i in range(ChangeRule.BLOCK))
    sums = first + (second + third + fourth)
    if whole == len(rows):
        return sums
    last = rows[whole : whole + 1]
    others = rows[whole + 1 :].sum(0, keepdim=True, dtype=rows.dtype)
    return torch.cat([sums, last + others])


def block_sigma(means: torch.Tensor) -> torch.Tensor:
    """Return []: the noise of block means of a difference, image units, within its bounds."""
    spread = MAD_TO_SIGMA * tensor_median((means - tensor_median(means)).abs())
    seconds = [
        (side[:-2] - 2 * side[1:-1] + side[2:]).abs().flatten()
        for side in (means, means.transpose(0, 1))
        if len(side) > 2
    ]
    if seconds:
        # The variance of a - 2 b + c is six times that of each.
        admitted = ChangeRule.MOST_OF_ROUGHNESS * MAD_TO_SIGMA * tensor_median(torch.cat(seconds)) / math.sqrt(6)
        spread = spread.minimum(admitted)
    return spread.clamp(ChangeRule.LEAST_SIGMA, ChangeRule.MOST_SIGMA)


def changed_tiles(blocks: torch.Tensor) -> torch.Tensor:
    """Return [V, ceil(H / 16), ceil(W / 16)] bool, of the blocks [V, ceil(H / 4), ceil(W / 4)] that changed."""
    count, number = count_per_tile(blocks, TILE // ChangeRule.BLOCK)
    return count >= number.clamp_max(ChangeRule.MIN_BLOCKS)


def count_per_tile(marked: torch.Tensor, side: int = TILE) -> tuple[torch.Tensor, torch.Tensor]:
    """Count what is marked in each tile: [..., rows, columns] how many are, and [rows, columns] how many there are.

    A tile cut off by the border has fewer to show a change with.

    Arguments:
        marked: [..., H, W] bool, pixels or blocks of them. side: of a tile, in these.
    """
    height, width = marked.shape[-2:]
    rows, columns = -(-height // side), -(-width // side)
    padded = pad(marked, (0, columns * side - width, 0, rows * side - height))
    count = padded.reshape(*marked.shape[:-2], rows, side, columns, side).sum((-3, -1))
    sizes = [
        (length - torch.arange(0, length, side, device=marked.device)).clamp_max(side) for length in (height, width)
    ]
    return count, torch.outer(*sizes)
