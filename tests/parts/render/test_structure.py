"""The structure of a picture: against a loop over its pixels, and against what a small shift changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsstream.parts.render.transforms import MIN_ERROR, weighted_structure_tensor


def by_hand(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    out = np.zeros_like(image)
    for y in range(height):
        for x in range(width):
            for c in range(3):
                right = 0.5 * (image[y, min(x + 1, width - 1), c] - image[y, max(x - 1, 0), c])
                down = 0.5 * (image[min(y + 1, height - 1), x, c] - image[max(y - 1, 0), x, c])
                weight = 1 / math.sqrt((image[y, x, c] - target[y, x, c]) ** 2 + MIN_ERROR**2)
                out[y, x] += weight * np.array([right * right, right * down, down * down])
    return out


@pytest.mark.parametrize("shape", [(5, 7), (1, 1), (1, 6), (4, 1)])
def test_it_is_the_sum_over_channels_of_products_of_gradients(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    image, target = rng.random((2, *shape, 3))
    found = weighted_structure_tensor(torch.from_numpy(image), torch.from_numpy(target))
    np.testing.assert_allclose(found.numpy(), by_hand(image, target), rtol=1e-12, atol=1e-12)


def test_a_picture_of_one_colour_holds_nothing() -> None:
    found = weighted_structure_tensor(torch.full((4, 4, 3), 0.3), torch.rand(4, 4, 3))
    assert not found.any()


@pytest.mark.parametrize("shift", [(0.5, 0.0), (0.0, 0.5), (0.4, -0.3)])
def test_it_foretells_the_squares_of_what_a_small_shift_changes(shift: tuple[float, float]) -> None:
    """Compared with itself a picture has the weight 1 / MIN_ERROR everywhere."""
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")

    def picture(dx: float, dy: float) -> torch.Tensor:
        wave = 0.5 + 0.2 * torch.sin(0.2 * (x - dx) + 0.13 * (y - dy)) + 0.1 * torch.cos(0.15 * (y - dy))
        return wave[..., None].expand(-1, -1, 3)

    image, inner = picture(0, 0), (slice(2, -2), slice(2, -2))
    xx, xy, yy = weighted_structure_tensor(image, image)[inner].sum((0, 1))
    dx, dy = shift
    foretold = dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy
    found = ((picture(dx, dy) - image)[inner] ** 2).sum() / MIN_ERROR
    assert float(foretold) == pytest.approx(float(found), rel=0.03)
