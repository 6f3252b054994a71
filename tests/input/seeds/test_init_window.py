"""Means over windows: the same as those of another implementation, at the borders too."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter

from gsstream.input.seeds.window import window_mean


@pytest.mark.parametrize("half", [0, 1, 2, 3, 6, 7, 11])
@pytest.mark.parametrize("shape", [(3, 1, 17, 23), (1, 1, 1, 5), (2, 1, 4, 1)])
def test_it_is_the_mean_of_another_implementation(half: int, shape: tuple[int, ...]) -> None:
    images = torch.rand(shape, generator=torch.Generator().manual_seed(half))
    expected = [uniform_filter(image[0].numpy().astype(np.float64), 2 * half + 1, mode="nearest") for image in images]
    np.testing.assert_allclose(window_mean(images, half)[:, 0].numpy(), np.stack(expected), rtol=2e-6, atol=1e-7)


def test_an_image_of_one_colour_stays_so() -> None:
    images = torch.full((1, 1, 9, 8), 0.3)
    torch.testing.assert_close(window_mean(images, 6), images, rtol=1e-6, atol=0)
    assert torch.equal(images, torch.full((1, 1, 9, 8), 0.3))  # what was given is not written to


def test_windows_do_not_write_to_what_they_were_given() -> None:
    images = torch.rand(2, 1, 12, 12, generator=torch.Generator().manual_seed(1))
    before = images.clone()
    for half in (0, 2, 6):
        window_mean(images, half)
    assert torch.equal(images, before)
