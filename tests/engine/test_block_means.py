"""Means over blocks, against numpy's own sums over ranges: to the bit, because thresholds are compared with them."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.engine.step.active.blocks import (
    BLOCK,
    LEAST_SIGMA,
    MOST_OF_ROUGHNESS,
    MOST_SIGMA,
    block_means,
    block_sigma,
    changed_blocks,
)
from gsstream.metrics.noise import MAD_TO_SIGMA


@pytest.mark.parametrize("height", [1, 3, 4, 5, 8, 11, 240])
@pytest.mark.parametrize("width", [1, 2, 4, 7, 12, 317])
def test_blocks_at_the_border_average_the_pixels_they_have(height: int, width: int) -> None:
    picture = np.random.default_rng(height).normal(size=(height, width, 3)).astype(np.float32)
    starts = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(picture, starts[0], 0), starts[1], 1)
    sizes = [np.minimum(BLOCK, n - s) for n, s in zip((height, width), starts, strict=True)]
    np.testing.assert_array_equal(block_means(picture), sums / np.outer(*sizes)[..., None])


def sigma_by_hand(means: np.ndarray) -> float:
    """Both estimates in full, with numpy's median."""
    spread = MAD_TO_SIGMA * np.median(np.abs(means - np.median(means)))
    second = [means[:-2] - 2 * means[1:-1] + means[2:], means[:, :-2] - 2 * means[:, 1:-1] + means[:, 2:]]
    values = np.abs(np.concatenate([part.ravel() for part in second]))
    rough = MOST_OF_ROUGHNESS * MAD_TO_SIGMA * np.median(values) / np.sqrt(6) if values.size else np.inf
    return float(min(max(min(spread, rough), LEAST_SIGMA), MOST_SIGMA))


@pytest.mark.parametrize("shape", [(4, 4), (8, 40), (40, 8), (9, 13), (120, 160)])
@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01, 0.05, 0.5])
@pytest.mark.parametrize("steepness", [0.0, 0.02, 0.3])
def test_noise_of_block_means_is_the_lesser_of_spread_and_roughness(
    shape: tuple[int, int], noise: float, steepness: float
) -> None:
    """Noise alone, where the spread decides, and a smooth change of the light, where second differences do."""
    rng = np.random.default_rng(5)
    ramp = steepness * np.linspace(-1, 1, shape[1])[None, :, None]
    difference = (ramp + noise * rng.normal(size=(*shape, 3))).astype(np.float32)
    means = block_means(difference)
    assert block_sigma(means) == sigma_by_hand(means)
    expected = (np.abs(means) > 4.0 * sigma_by_hand(means)).any(-1)
    np.testing.assert_array_equal(changed_blocks(difference, 4.0), expected)
