"""Tiles of the training images that growth does without and that judge it: when more Gaussians stop helping there.

What is left out are tiles, not cameras: a camera that joins when growth has ended has missed the iterations that move
Gaussians far, and a rig of eight lost 0.8 dB by it. A tile is also seen under the exposure of its own camera, which the
other tiles of that camera fit. docs/results/frame0.md: test cameras lose by it yet, so it is off.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.exposure import Exposure
from gsstream.recipe.model import FirstFrame
from gsstream.render.base import TILE, Renderer

#: With fewer training cameras than this, what a tile hides from one of them is hardly seen by the others.
LEAST_CAMERAS = 4
#: One tile in so many is left out of every training image.
TILES_TO_JUDGES = 8
#: Squared error that counts as none: that of rounding to 8 bits.
LEAST_ERROR = 1 / (12 * 255**2)
#: What twice as many Gaussians must gain on the tiles left out, dB.
DOUBLED = 0.25
#: Looks in a row without such a gain after which growth ends.
PATIENCE = 2


@dataclass(frozen=True)
class Growth:
    """What the tiles left out said while Gaussians grew, and whether growth still pays.

    A look pays when PSNR has gained at least ``DOUBLED`` for every doubling of the number of Gaussians since the last
    look that paid, and anything at all. Growth ends after ``PATIENCE`` looks in a row that did not pay.

    Arguments:
        gaussians, psnr: at the last look that paid; 0 and -inf before the first.
        misses: looks since then.
    """

    gaussians: int = 0
    psnr: float = -math.inf
    misses: int = 0

    def look(self, gaussians: int, psnr: float) -> Growth:
        """Return what is known after one more look.

        Arguments:
            gaussians: number of Gaussians now, at least 1.
            psnr: of the tiles that were left out, dB.
        """
        if self.gaussians > 0:
            doublings = math.log2(max(1.0, gaussians / self.gaussians))
            if not psnr > self.psnr or psnr - self.psnr < DOUBLED * doublings:
                return replace(self, misses=self.misses + 1)
        return Growth(gaussians, psnr)

    @property
    def pays(self) -> bool:
        """Whether Gaussians may still be born."""
        return self.misses < PATIENCE


def left_out_tiles(settings: FirstFrame, frame: Frame, rng: Rng) -> torch.Tensor | None:
    """Return [V, ceil(H / 16), ceil(W / 16)] bool: the tiles that only judge; None where nothing judges growth.

    They are drawn at random, one in eight and at least one of every image. With fewer than four training cameras none
    are left out, which a warning says.

    Arguments:
        settings: section ``first_frame`` of the recipe.
        frame: training images of frame 0.
        rng: random streams by name and frame.
    """
    views, height, width = frame.images.shape[:3]
    if settings.stop_growth == "never":
        return None
    if views < LEAST_CAMERAS:
        warnings.warn(
            f"first_frame.stop_growth: expected at least {LEAST_CAMERAS} training cameras, so that the others see what "
            f"is left out of one, got {views}; Gaussians grow as with 'never'",
            stacklevel=2,
        )
        return None
    rows, columns = math.ceil(height / TILE), math.ceil(width / TILE)
    generator = rng.stream("tiles that judge growth", frame.index)
    tiles = torch.zeros(views, rows * columns, dtype=torch.bool)
    for view in range(views):
        order = torch.randperm(rows * columns, generator=generator)
        tiles[view, order[: max(1, rows * columns // TILES_TO_JUDGES)]] = True
    return tiles.reshape(views, rows, columns)


def judged(
    renderer: Renderer, gaussians: Gaussians[torch.Tensor], frame: Frame, tiles: torch.Tensor,
    background: tuple[float, float, float], exposure: Exposure | None,
) -> float:  # fmt: skip
    """Return the mean PSNR of single tiles of training images, dB.

    It is the mean of tiles, not of images, because few tiles hold most of the squared error of an image: from one look
    to the next the PSNR of images fell by 0.45 dB while that of the median tile rose by 0.15.

    Arguments:
        renderer: of the run.
        gaussians: N rows, raw values, without gradients.
        frame: training images of frame 0.
        tiles: [V, ceil(H / 16), ceil(W / 16)] bool, at least one of every camera.
        background: colour behind everything, 0 to 1.
        exposure: colour maps of the cameras, or None.
    """
    session = renderer.open(gaussians, None, frame.cameras, background)
    found = []
    for view, mask in enumerate(tiles):
        with torch.no_grad():
            image = session.render(view, gaussians, tile_mask=mask).image
        image = (exposure.apply(view, image) if exposure else image).clamp(0, 1)
        error = np.square(image.numpy().astype(np.float64) - frame.images[view]).mean(2)
        found.append(_tile_means(error)[mask.numpy()])
    return float(-10 * np.log10(np.concatenate(found).clip(LEAST_ERROR)).mean())


def _tile_means(values: FloatArray) -> FloatArray:
    """[ceil(H / 16), ceil(W / 16)] mean of every tile of [H, W]."""
    height, width = values.shape
    sums = np.add.reduceat(np.add.reduceat(values, range(0, height, TILE), 0), range(0, width, TILE), 1)
    sizes = [np.minimum(TILE, extent - np.arange(0, extent, TILE)) for extent in (height, width)]
    means: FloatArray = sums / np.outer(*sizes)
    return means
