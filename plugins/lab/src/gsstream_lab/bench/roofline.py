"""How much work a render cannot avoid, and how long this machine needs for it at best.

Counted, not estimated: Gaussians in view and live pixel pairs (a Gaussian and a pixel it adds light to) come from a
plain front-to-back pass of our own, independent of every renderer under test. The cost of each is the least that the
formulas ask for (docs: gsstream bench render --help): a pair takes 34 floating-point operations forward and 80
backward, a Gaussian in view about 700 and 1400 (projection, harmonics of degree 2); every row is read once each way and
its gradient written once. Arithmetic and memory times are added: the floor of a machine that does not overlap them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.backend.reference import ALPHA_CUT, ALPHA_MAX, TRANSMITTANCE_MIN, project
from gsstream.parts.render.images import TILE

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
FLOPS_PER_PAIR = (34, 80)
FLOPS_PER_VISIBLE = (700, 1400)
_FLOAT = 4


@dataclass(frozen=True, slots=True)
class Peak:
    """What the machine reaches with ``threads`` threads: 10^9 float32 operations and 10^9 bytes moved a second."""

    threads: int
    gflops: float
    gbytes_per_second: float


@dataclass(frozen=True, slots=True)
class Footprints:
    """Where the Gaussians of a scene lie in one image."""

    means2d: FloatArray  # [N, 2] pixels
    half: FloatArray  # [N, 2] half sides of the box around alpha >= 1/255
    conics: FloatArray  # [N, 3] upper triangle of the inverse covariance
    #: depths, opacities: [N].
    depths: FloatArray
    opacities: FloatArray
    visible: BoolArray  # [N] bool, in front of the camera and the box meets the image
    width: int
    height: int

    def in_tiles(self, mask: BoolArray) -> IntArray:
        """Return the rows whose centre lies in a tile of the mask: those the benchmark lets move."""
        rows = np.flatnonzero(self.visible)
        tile = np.floor(self.means2d[rows] / TILE).astype(np.int64)
        known = (tile >= 0).all(1) & (tile[:, 0] < mask.shape[1]) & (tile[:, 1] < mask.shape[0])
        rows, tile = rows[known], tile[known]
        return rows[mask[tile[:, 1], tile[:, 0]]]


def footprints(gaussians: Gaussians[FloatArray], cameras: Cameras, view: int = 0) -> Footprints:
    """Project a scene with the reference renderer's formulas."""
    with torch.no_grad():
        means2d, conics, _, depths, opacities = project(gaussians.map(torch.from_numpy), cameras, view)
        variances = torch.linalg.inv(conics).diagonal(dim1=1, dim2=2)
        reach = 2 * torch.log(opacities / ALPHA_CUT)
        half = (reach[:, None].clamp_min(0) * variances).sqrt()
        size = torch.tensor([cameras.width, cameras.height])
        seen = ((means2d + half >= 0.5) & (means2d - half <= size - 0.5)).all(1)
        seen &= (depths > cameras.near_plane) & (reach >= 0)
        triangle = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], 1)
    return Footprints(
        means2d=means2d.numpy(),
        half=half.numpy(),
        conics=triangle.numpy(),
        depths=depths.numpy(),
        opacities=opacities.numpy(),
        visible=seen.numpy(),
        width=cameras.width,
        height=cameras.height,
    )


def live_pairs(scene: Footprints) -> IntArray:
    """Return [H, W]: number of Gaussians that add light to each pixel."""
    counts = np.zeros((scene.height, scene.width), np.int64)
    light = np.ones((scene.height, scene.width), np.float32)
    rows = np.flatnonzero(scene.visible)
    rows = rows[np.argsort(scene.depths[rows], kind="stable")]
    size = np.array([scene.width, scene.height])
    first = np.ceil(scene.means2d[rows] - scene.half[rows] - 0.5).clip(0, size).astype(np.int64)
    last = (np.floor(scene.means2d[rows] + scene.half[rows] - 0.5) + 1).clip(0, size).astype(np.int64)
    xs = np.arange(scene.width, dtype=np.float32) + np.float32(0.5)
    ys = np.arange(scene.height, dtype=np.float32) + np.float32(0.5)
    for row, (x0, y0), (x1, y1) in zip(rows.tolist(), first.tolist(), last.tolist(), strict=True):
        window = light[y0:y1, x0:x1]
        if not window.size:
            continue
        a, b, c = scene.conics[row]
        dx, dy = xs[x0:x1] - scene.means2d[row, 0], (ys[y0:y1] - scene.means2d[row, 1])[:, None]
        alpha = scene.opacities[row] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        live = (alpha >= ALPHA_CUT) & (window > TRANSMITTANCE_MIN)
        counts[y0:y1, x0:x1] += live
        window *= np.where(live, 1 - np.minimum(alpha, ALPHA_MAX), 1)
    return counts


def central_tiles(width: int, height: int, share: float) -> BoolArray:
    """Return [tile rows, tile columns] bool: the share of tiles nearest to the image's centre, at least one."""
    rows, columns = -(-height // TILE), -(-width // TILE)
    y, x = np.mgrid[:rows, :columns] + 0.5
    distance = np.hypot(x - columns / 2, y - rows / 2).ravel()
    mask = np.zeros(rows * columns, bool)
    mask[np.argsort(distance, kind="stable")[: max(1, round(share * rows * columns))]] = True
    return mask.reshape(rows, columns)


def pixels_of(mask: BoolArray, width: int, height: int) -> BoolArray:
    """Return a tile mask as a pixel mask [H, W]."""
    return mask.repeat(TILE, 0).repeat(TILE, 1)[:height, :width]


def roofline_ms(peak: Peak, *, pairs: int, visible: int, rows: int, pixels: int, floats: int) -> tuple[float, float]:
    """Return the milliseconds that forward and backward take at least."""
    image = 4 * _FLOAT * pixels
    moved = (_FLOAT * floats * rows + image, 2 * _FLOAT * floats * rows + image)
    return tuple(  # type: ignore[return-value]
        (pairs * FLOPS_PER_PAIR[i] + visible * FLOPS_PER_VISIBLE[i]) / peak.gflops / 1e6
        + moved[i] / peak.gbytes_per_second / 1e6
        for i in (0, 1)
    )
