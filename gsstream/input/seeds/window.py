"""Means over square windows around every pixel, with few operations on whole images."""

from __future__ import annotations

import torch
import torch.nn.functional as F


def window_mean(images: torch.Tensor, half: int) -> torch.Tensor:
    """Return the mean over a square of 2 half + 1 pixels around every pixel; borders are replicated."""
    side = 2 * half + 1
    padded = F.pad(images, (half, half, half, half), mode="replicate")
    return _window_sum(_window_sum(padded, -1, side), -2, side) / (side * side)


def _window_sum(values: torch.Tensor, dim: int, side: int) -> torch.Tensor:
    """Sums of ``side`` neighbours along a dimension, put together from sums of 1, 2, 4, ... of them.

    A window of 13 takes five additions so, one after the other twelve.
    """
    number = values.shape[dim] - side + 1
    found, sums, width, begin = None, values, 1, 0
    while True:
        if side & width:
            piece = sums.narrow(dim, begin, number)
            found = piece if found is None else found + piece
            begin += width
        if 2 * width > side:
            assert found is not None  # the highest bit of side is set
            return found
        both = sums.shape[dim] - width
        sums, width = sums.narrow(dim, 0, both) + sums.narrow(dim, width, both), 2 * width
