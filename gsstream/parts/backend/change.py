"""Which tiles of which views changed between two frames, beyond the measured noise of their camera; in torch.

Differences are averaged over small blocks of pixels, in which noise averages out and a change does not. Every other
body finds the same tiles, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import torch
from torch.nn.functional import max_pool2d, normalize, one_hot, pad

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
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

    def with_tiles(self, tiles: torch.Tensor) -> Self:
        """Return the change with these tiles, too: [V, ceil(H / 16), ceil(W / 16)] bool."""
        return replace(self, tiles=self.tiles | tiles)

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
        # One view after another on the processor, as numbers; on a GPU all views in one go, which is queued once.
        at_once = 1 if means.device.type == "cpu" else len(cameras)
        hits, seen = torch.zeros_like(means[:, 0]), torch.zeros_like(means[:, 0])
        for first in range(0, len(cameras), at_once):
            views = slice(first, first + at_once)
            inside, marked = self._found(means, cameras, views)
            seen, hits = seen + inside.sum(0), hits + (inside & marked).sum(0)
        return hits / seen.clamp_min(1)

    def within(
        self, able: torch.Tensor, gaussians: Gaussians[torch.Tensor], cameras: Cameras, min_votes: float
    ) -> torch.Tensor:
        """Return those of the rows ``able`` [N] bool of which both ends have at least this share of votes.

        An end lies one standard deviation from the centre along the longest axis.
        """
        some = gaussians.rows(able.nonzero()[:, 0])
        along, quats = one_hot(some.scales.argmax(1), 3) * some.scales.exp(), normalize(some.quats)
        twist = 2 * torch.linalg.cross(quats[:, 1:], along)
        reach = along + quats[:, :1] * twist + torch.linalg.cross(quats[:, 1:], twist)  # the axis, turned
        ends = torch.cat([some.means + reach, some.means - reach])
        return able.masked_scatter(able, (self.votes(ends, cameras) >= min_votes).view(2, -1).all(0))

    def _found(self, means: torch.Tensor, cameras: Cameras, views: slice) -> tuple[torch.Tensor, torch.Tensor]:
        """[V, N] bool: whether centres project into these views, and whether in or beside a tile that changed."""
        poses, Ks = cameras.viewmats[views, :3].astype("float32"), cameras.Ks[views, :2].astype("float32")
        pose = torch.from_numpy(poses).to(means.device).permute(1, 2, 0)[..., None]  # [3, 4, V, 1]
        K = torch.from_numpy(Ks).to(means.device).permute(1, 2, 0)[..., None]
        x, y, z = (row[0] * means[:, 0] + row[1] * means[:, 1] + row[2] * means[:, 2] + row[3] for row in pose)
        inside = z > cameras.near_plane
        inverse = 1 / torch.where(inside, z, 1.0)
        u, v = K[0, 0] * x * inverse + K[0, 2], K[1, 1] * y * inverse + K[1, 2]
        inside = inside & (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        u, v = (torch.where(inside, of, 0.0) * (1 / TILE) for of in (u, v))
        columns = -(-self.width // TILE)
        return inside, self.dilated[views].flatten(1).gather(1, v.long() * columns + u.long())

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
    height, width = now[0].shape[:2]
    # One by one on the processor, whose cache holds a picture; on a GPU in one go, because it is queued that often.
    step = 1 if now[0].device.type == "cpu" else len(now)
    groups = [slice(at, at + step) for at in range(0, len(now), step)]
    blocks = [changed_blocks(torch.stack(list(before[at])), torch.stack(list(now[at])), threshold) for at in groups]
    return Change(changed_tiles(torch.cat(blocks)), height, width)


def changed_blocks(before: torch.Tensor, now: torch.Tensor, threshold: float) -> torch.Tensor:
    """Return [V, ceil(H / 4), ceil(W / 4)] bool: blocks whose mean difference exceeds the noise of block means."""
    means = block_means(_difference(before, now))
    return (means.abs() > threshold * block_sigma(means)[:, None, None, None]).any(-1)


def _difference(before: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
    """[V, H, W, 3] float32, or int16 in levels of 8 bits where both images are stored as bytes."""
    if before.dtype == now.dtype == torch.uint8:
        return now.short() - before.short()
    return float_image(now) - float_image(before)


def block_means(picture: torch.Tensor) -> torch.Tensor:
    """Return [..., ceil(H / 4), ceil(W / 4), 3] float64 means of [..., H, W, 3].

    Border blocks average the pixels they have. Of int16 the sums are exact (they stay below 2^12), and a level is
    1 / 255.
    """
    sums = _sums(_sums(picture, -3), -2).double()
    if picture.dtype == torch.int16:
        sums = sums / 255.0
    sizes = [
        (side - torch.arange(0, side, ChangeRule.BLOCK, device=picture.device)).clamp_max(ChangeRule.BLOCK)
        for side in picture.shape[-3:-1]
    ]
    return sums / torch.outer(*sizes)[..., None]


def _sums(values: torch.Tensor, axis: int) -> torch.Tensor:
    """Sums over BLOCK places each along an axis, always added in this order; the last block may have fewer."""
    rows = values.movedim(axis, 0)
    whole = len(rows) // ChangeRule.BLOCK * ChangeRule.BLOCK
    first, second, third, fourth = (rows[i : whole : ChangeRule.BLOCK] for i in range(ChangeRule.BLOCK))
    sums = first + (second + third + fourth)
    if whole < len(rows):
        others = rows[whole + 1 :].sum(0, keepdim=True, dtype=rows.dtype)
        sums = torch.cat([sums, rows[whole : whole + 1] + others])
    return sums.movedim(0, axis)


def block_sigma(means: torch.Tensor) -> torch.Tensor:
    """Return [...]: the noise of block means [..., rows, columns, 3] of differences, image units, within bounds."""
    flat = means.flatten(-3)
    spread = MAD_TO_SIGMA * tensor_median((flat - tensor_median(flat)[..., None]).abs())
    sides = [means.movedim(axis, -1) for axis in (-3, -2)]
    seconds = [
        (side[..., :-2] - 2 * side[..., 1:-1] + side[..., 2:]).abs().flatten(-3) for side in sides if side.shape[-1] > 2
    ]
    if seconds:
        # The variance of a - 2 b + c is six times that of each.
        admitted = ChangeRule.MOST_OF_ROUGHNESS * MAD_TO_SIGMA * tensor_median(torch.cat(seconds, -1)) / math.sqrt(6)
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
