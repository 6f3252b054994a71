"""SSIM's variants, MS-SSIM, FLIP and flicker against independent implementations and cases worked out by hand."""

from __future__ import annotations

import math

import kornia.metrics
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.errors import ShapeError
from gsstream.metrics import flicker, flip, ms_ssim, ssim


def images(height, width, noise, seed=0):
    """A smooth picture and a noisy copy, as 3DGS residuals look."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 40
    smooth = np.stack([np.sin(x) * np.cos(y), np.cos(x + y), np.sin(2 * y)], -1) / 2 + 0.5
    return smooth, np.clip(smooth + noise * rng.normal(size=smooth.shape), 0, 1)


def tensor(image):
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]


@settings(max_examples=15, deadline=None)
@given(st.integers(11, 150), st.integers(11, 60), st.floats(0, 0.5), st.integers(0, 9))
def test_ssim_variants_agree_with_kornia(height, width, noise, seed):
    first, second = images(height, width, noise, seed)
    reflected = kornia.metrics.ssim(tensor(first), tensor(second), 11, padding="same").mean().item()
    inside = kornia.metrics.ssim(tensor(first), tensor(second), 11, padding="valid").mean().item()
    assert ssim(first, second, "reflect") == pytest.approx(reflected, abs=1e-6)
    assert ssim(first, second, "valid") == pytest.approx(inside, abs=1e-6)


@pytest.mark.parametrize("size", [(176, 176), (192, 256), (208, 320)])
@pytest.mark.parametrize("noise", [0.02, 0.1, 0.5])
def test_ms_ssim_agrees_with_pytorch_msssim(size, noise):
    reference = pytest.importorskip("pytorch_msssim", reason="needs pytorch-msssim (MIT) as reference")
    first, second = images(*size, noise)
    expected = reference.ms_ssim(tensor(first), tensor(second), data_range=1.0).item()
    assert ms_ssim(first, second) == pytest.approx(expected, abs=1e-5)


def test_ms_ssim_agrees_with_its_definition_written_with_torch():
    """Wang et al. 2003 once more, with other means: convolution, pooling, odd sizes."""
    first, second = images(181, 247, 0.1)
    x, y = tensor(first), tensor(second)
    taps = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / 4.5)
    window = torch.outer(taps, taps) / taps.sum() ** 2
    kernel = window.expand(3, 1, 11, 11)

    def blur(image):
        return torch.nn.functional.conv2d(image, kernel, groups=3)

    value = torch.ones(3, dtype=torch.float64)
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        mx, my = blur(x), blur(y)
        cs = (2 * (blur(x * y) - mx * my) + 9e-4) / (blur(x * x) - mx**2 + blur(y * y) - my**2 + 9e-4)
        lum = (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
        value = value * (lum * cs if scale == 4 else cs).mean((0, 2, 3)).clamp_min(0) ** exponent
        x, y = (torch.nn.functional.avg_pool2d(image, 2) for image in (x, y))
    assert ms_ssim(first, second) == pytest.approx(value.mean().item(), abs=1e-9)


def test_extremes():
    first, second = images(176, 180, 0.3)
    for measure in (ms_ssim, lambda a, b: ssim(a, b, "valid"), lambda a, b: ssim(a, b, "reflect")):
        assert measure(first, first) == pytest.approx(1, abs=1e-12)
        assert measure(first, second) < 0.9
    inverted = 1 - first
    assert ms_ssim(first, inverted) == 0, "negative structure has no power: it counts as none"
    with pytest.raises(ShapeError, match="at least 176"):
        ms_ssim(first[:175], second[:175])
    with pytest.raises(ShapeError, match="above 10"):
        ssim(first[:10], second[:10], "valid")


def test_flip_is_that_of_its_authors():
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator (extra: metrics)")
    first, second = images(64, 80, 0.1)
    assert flip(first, first) == 0
    assert 0.01 < flip(second, first) < flip(1 - first, first) <= 1
    black, white = np.zeros((32, 32, 3)), np.ones((32, 32, 3))
    assert flip(white, black) == pytest.approx(0.9762, abs=0.02), "the largest step there is: nearly 1"
    with pytest.raises(ShapeError):
        flip(first, second[:-1])


def test_flicker_counts_still_pixels_of_decoded_frames_alone():
    rng = np.random.default_rng(0)
    scene = rng.random((40, 40, 3)) * 0.5
    noisy = [scene + 0.01 * rng.normal(size=scene.shape) for _ in range(2)]
    calm = scene + 0.2  # wrong, but calm
    assert flicker(calm, calm, *noisy, 0.01) == 0
    restless = calm + (4 / 255) * np.where(np.indices((40, 40)).sum(0) % 2, 1, -1)[..., None]
    assert flicker(restless, calm, *noisy, 0.01) == pytest.approx(4)
    moved = scene.copy()
    moved[:20] += 0.4
    changed = calm.copy()
    changed[:18] = 0
    assert flicker(changed, calm, moved, scene, 0.0) == 0, "what moves in the recording is not flicker"
    assert math.isnan(flicker(calm, calm, scene + 0.5, scene, 0.0))
