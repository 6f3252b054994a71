"""The structure of a picture: how much it changes where something in it is shifted."""

from __future__ import annotations

import torch

#: A value that is off by less than this counts as one that is off by this much, in [0, 1] image units.
MIN_ERROR = 0.03


def weighted_structure_tensor(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return [H, W, 3]: the structure tensor of a picture at every pixel, as xx, xy and yy per pixel^2.

    It is the sum over the channels of the products of the two gradients (Lucas and Kanade 1981; central differences,
    those of the border see the border again), weighed by 1 / sqrt(error^2 + MIN_ERROR^2): where a picture is shifted by
    a small d, d^T S d / 2 is the second-order term of the sum of sqrt(error^2 + MIN_ERROR^2), by the parabola that lies
    above it (iteratively reweighted least squares).
    """
    down, right = _image_gradients(image, 0), _image_gradients(image, 1)
    weight = ((image - target).square() + MIN_ERROR**2).rsqrt()
    pairs = (right, right), (right, down), (down, down)
    return torch.stack([(weight * one * other).sum(-1) for one, other in pairs], -1)


def _image_gradients(image: torch.Tensor, axis: int) -> torch.Tensor:
    last = image.shape[axis] - 1
    places = torch.arange(last + 1, device=image.device)
    after = image.index_select(axis, (places + 1).clamp_max(last))
    return 0.5 * (after - image.index_select(axis, (places - 1).clamp_min(0)))
