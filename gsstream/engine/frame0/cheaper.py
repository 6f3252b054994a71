"""View-dependent colour of frame 0 is rounded by what a bit buys: a coefficient stays only where the images feel it.

Most of these coefficients explain noise, or hardly anything: most Gaussians are small, hidden or seen from one side.
Each takes the code that makes squared error plus weight times bits least, among the nearest
one, its neighbours towards zero and zero itself (rate-distortion optimised quantisation, as video encoders do it).
The packet's format is the same, and a player does not know of it. Colours of degree 0 are left alone: where no training
camera sees a Gaussian they would become grey, and other cameras do see it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.exposure import Exposure
from gsstream.packet.grids import KEY_BITS, color_codes, color_slopes, from_codes

BITS = KEY_BITS["shN"]
#: How often the bits of a code are estimated from what was chosen. The third time changes next to nothing.
ROUNDS = 3
#: Count of a code that nobody has chosen yet, so that its bits are many, but a number.
UNUSED = 0.05


def cheaper_colors(
    parts: Assembly, gaussians: Gaussians[torch.Tensor], frame: Frame, exposure: Exposure | None, rng: Rng
) -> Gaussians[torch.Tensor]:
    """Return the Gaussians with view-dependent colours that a key packet holds in fewer bytes (``codec.key_rate``).

    Arguments:
        parts: the live parts of the recipe.
        gaussians: N rows as frame 0 was fitted, raw values.
        frame: training images of frame 0.
        exposure: colour maps of the cameras, or None.
        rng: random streams by name and frame.
    """
    rate = parts.recipe.codec.key_rate
    if rate == 0 or gaussians.shN.numel() == 0:
        return gaussians
    felt, error = _felt(parts, gaussians, frame, exposure, rng.stream("key rate", frame.index))
    codes = chosen_codes(color_codes(gaussians.shN.numpy(), BITS), felt, rate * error)
    return replace(gaussians, shN=torch.from_numpy(from_codes("shN", codes, BITS)).reshape(gaussians.shN.shape))


def chosen_codes(exact: FloatArray, felt: FloatArray, weight: float) -> IntArray:
    """Return the codes [N, width] int32 with the least ``felt (code - exact)^2 + weight bits``, column by column.

    The bits of a code are those of a coder that knows how often each one occurs in its column.

    Arguments:
        exact: [N, width] codes before rounding.
        felt: [N, width] squared error of all images, for a code that is off by one.
        weight: squared error that a bit must save, at least 0.
    """
    nearest = np.rint(exact).astype(np.int32)
    if weight == 0 or nearest.size == 0:
        return nearest
    return np.stack([_column(*columns, weight) for columns in zip(exact.T, nearest.T, felt.T, strict=True)], 1)


def _column(exact: FloatArray, nearest: IntArray, felt: FloatArray, weight: float) -> IntArray:
    towards = np.sign(nearest)
    candidates = np.stack([nearest, nearest - towards, nearest - 2 * towards, np.zeros_like(nearest)])
    # A code of 1 has no neighbour two towards zero on its side of it.
    candidates[2] = np.where(np.abs(nearest) > 1, candidates[2], 0)
    error = felt * (candidates - exact) ** 2
    low = int(min(candidates.min(), 0))
    chosen = nearest
    for _ in range(ROUNDS):
        counts = np.bincount(chosen - low, minlength=int(candidates.max()) - low + 1) + UNUSED
        bits = -np.log2(counts / counts.sum())
        best = np.argmin(error + weight * bits[candidates - low], 0)
        chosen = candidates[best, np.arange(len(best))]
    return chosen


def _felt(
    parts: Assembly, gaussians: Gaussians[torch.Tensor], frame: Frame, exposure: Exposure | None,
    generator: torch.Generator,
) -> tuple[FloatArray, float]:  # fmt: skip
    """How much the training images feel each code [N, width], and their mean squared error.

    Images are pulled back with random signs: the mean square of that slope is the sum of the squared slopes of all
    pixels, so one pass over the cameras gives the diagonal of the Gauss-Newton matrix (Hutchinson's estimate).
    """
    felt: FloatArray = np.zeros((len(gaussians), gaussians.shN[0].numel()))
    error = 0.0
    views = len(frame.cameras)
    session = parts.renderer.open(gaussians, None, frame.cameras, parts.recipe.background)
    for view in range(views):
        leaves = gaussians.map(lambda value: value.detach().clone().requires_grad_())
        image = session.render(view, leaves).image
        seen = image.detach() if exposure is None else exposure.apply(view, image.detach())
        error += float((seen - torch.from_numpy(frame.images[view])).square().mean()) / views
        signs = torch.randint(0, 2, image.shape, generator=generator).to(image.dtype) * 2 - 1
        pull_back([image], [signs if exposure is None else exposure.pull(view, signs)])
        if leaves.shN.grad is not None:
            felt += color_slopes(leaves.shN.grad.numpy(), BITS) ** 2
    return felt, error
