"""Loss: (1 - w) L1 + w (1 - SSIM) and its gradient by the image; the contract, and the reference in plain torch.

SSIM is the 3DGS variant: 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels (Kerbl et al.
2023; Wang et al. 2004).
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, final

import torch
from torch.nn.functional import conv2d

from gsstream.parts.render.images import float_image, spread_to_pixels

WINDOW, SIGMA = 11, 1.5
#: Wang et al.: (0.01 L)^2 and (0.03 L)^2 for values from 0 to L = 1.
C1, C2 = 0.01**2, 0.03**2


class PreparedTarget(NamedTuple):
    """An image as planes [3, 1, H, W], and of its windows, of the same shape: mean, mean^2 + C1, variance + C2."""

    planes: torch.Tensor
    mean: torch.Tensor
    energy: torch.Tensor
    variance: torch.Tensor


class Loss(ABC):
    """(1 - w) L1 + w (1 - SSIM) of an image and its gradient by the image, without an autograd graph.

    Every implementation gives the numbers of :class:`ReferenceLoss`, up to rounding: make yours faster, not different.
    ``prepare`` is called once per target and frame, ``evaluate`` once per iteration.
    """

    @abstractmethod
    def prepare(self, target: torch.Tensor) -> Any:
        """Precompute what depends only on the target; opaque to the engine.

        Arguments:
            target: [H, W, 3] float32 in [0, 1], or uint8 of which 255 is 1.0: the same image, bit for bit.
        """

    @abstractmethod
    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of ``image`` [H, W, 3] as a tensor [], on the CPU float64, and its gradient [H, W, 3].

        Arguments:
            image: [H, W, 3] rendered.
            prepared: what :meth:`prepare` returned of the target.
            dssim: weight w of 1 - SSIM, 0 to 1.
            tile_mask: [ceil(H / 16), ceil(W / 16)] bool, tiles to evaluate; None: all. The sum runs over these tiles
                and their neighbours, whose SSIM windows overlap them, divided by the number of pixels of the image.
                In these tiles the gradient is that of the whole loss; elsewhere it is 0. ``image`` must be valid in
                the neighbours too.
        """


@final
class ReferenceLoss(Loss):
    """Separable SSIM with its gradient written out, on the device of the image."""

    def prepare(self, target: torch.Tensor) -> Any:
        planes = float_image(target).permute(2, 0, 1)[:, None].contiguous()
        mean, square = _windowed(torch.cat([planes, planes * planes])).chunk(2)
        energy = mean * mean
        return PreparedTarget(planes, mean, energy + C1, square - energy + C2)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        planes = image.detach().permute(2, 0, 1)[:, None]
        weight = None if tile_mask is None else _pixel_weight(image, _with_neighbours(tile_mask))
        similar, by_mean, by_square, by_product = ssim_and_grads(planes, prepared)
        difference = planes - prepared.planes
        each = torch.lerp(difference.abs(), 1 - similar, dssim)
        grads = torch.cat([by_mean, by_square, by_product])
        if weight is not None:
            each, grads = each * weight, grads * weight
        # The window is symmetric, so the gradient by what it was slid over is the same window over the gradient.
        by_mean, by_square, by_product = _windowed(grads).chunk(3)
        by_ssim = torch.addcmul(by_mean, planes, by_square, value=2).addcmul_(prepared.planes, by_product)
        sign = difference.sign_() if weight is None else difference.sign_() * weight
        gradient = sign.mul_((1 - dssim) / image.numel()).sub_(by_ssim, alpha=dssim / image.numel())
        value = each.mean()
        if tile_mask is not None:
            gradient = gradient * _pixel_weight(image, tile_mask)
        return value.double(), gradient[:, 0].permute(1, 2, 0).contiguous()


def ssim_and_grads(planes: torch.Tensor, target: PreparedTarget) -> tuple[torch.Tensor, ...]:
    """Return the structural similarity of an image's planes [3, 1, H, W] to a target, pixel by pixel.

    Beside it, of the same shape, its derivatives by the window's mean of the image, of its square, and of its product
    with the target.
    """
    mean, square, product = _windowed(torch.cat([planes, planes * planes, planes * target.planes])).chunk(3)
    both, energy = mean * target.mean, mean * mean
    luminance = 2 * both + C1
    contrast = 2 * (product - both) + C2
    means, variances = energy + target.energy, square - energy + target.variance
    by_product = luminance / (means * variances)
    similar = by_product * contrast
    by_square = similar / variances
    # A higher mean makes both luminances and covariance change, and both energies: one by each way.
    ways = target.mean * (similar / luminance - by_product)
    by_mean = torch.addcmul(ways, mean, by_square - similar / means)
    return similar, by_mean.mul_(2), by_square.neg_(), by_product.mul_(2)


def _windowed(planes: torch.Tensor) -> torch.Tensor:
    """Weighted means over the window around every pixel of planes [n, 1, H, W]; beyond the border stand zeros."""
    # As n channels of one picture, each slid over by itself: half of the time of n pictures of one channel.
    channels, count = planes.transpose(0, 1), len(planes)
    weights = window_weights(planes.device, planes.dtype).expand(count, 1, WINDOW, 1)
    down = conv2d(channels, weights, padding=(WINDOW // 2, 0), groups=count)
    return conv2d(down, weights.transpose(2, 3), padding=(0, WINDOW // 2), groups=count).transpose(0, 1)


@functools.cache
def window_weights(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """Return the weights [1, 1, 11, 1] of a window along one axis; kept, so that they cross to a device once."""
    places = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-0.5 * (places / SIGMA) ** 2)
    return (weights / weights.sum()).to(dtype).to(device)[None, None, :, None]


def _with_neighbours(tile_mask: torch.Tensor) -> torch.Tensor:
    """The windows of pixels in neighbouring tiles see a changed tile: radius 5 is less than a tile."""
    return torch.nn.functional.max_pool2d(tile_mask[None].float(), 3, 1, 1)[0]


def _pixel_weight(image: torch.Tensor, tile_mask: torch.Tensor) -> torch.Tensor:
    """[H, W]: 1 in marked tiles, else 0."""
    return spread_to_pixels(tile_mask.to(image.dtype), *image.shape[:2])
