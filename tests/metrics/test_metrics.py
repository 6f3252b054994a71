"""Metrics against independent implementations and against what they are meant to detect."""

from __future__ import annotations

import math
import subprocess
import sys

import kornia
import numpy as np
import pytest
import torch
import torch.nn.functional as functional
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.errors import ShapeError
from gsstream.core.median import median
from gsstream.metrics import moving_mask, noise_sigma, psnr, psnr_moving, slope_per_100, ssim
from gsstream.metrics.noise import median_deviation


def pair(seed=0, height=40, width=56, noise=0.1):
    rng = np.random.default_rng(seed)
    image = rng.random((height, width, 3)).astype(np.float32)
    return image, np.clip(image + noise * rng.normal(size=image.shape), 0, 1).astype(np.float32)


def test_psnr_of_known_errors():
    zeros = np.zeros((10, 20, 3), np.float32)
    assert psnr(zeros + 0.1, zeros) == pytest.approx(20, abs=1e-5)
    assert psnr(zeros + 1, zeros) == pytest.approx(0)
    assert psnr(zeros, zeros) == math.inf
    a, b = pair()
    assert psnr(a, b) == psnr(b, a) == pytest.approx(10 * math.log10(1 / np.mean((a.astype(float) - b) ** 2)))


def test_psnr_counts_only_masked_pixels():
    a, b = pair()
    mask = np.zeros(a.shape[:2], bool)
    mask[5:9, 3:30] = True
    spoiled = np.where(mask[..., None], a, 1 - a)
    assert psnr(spoiled, b, mask) == pytest.approx(psnr(a[5:9, 3:30], b[5:9, 3:30]))
    assert math.isnan(psnr(a, b, np.zeros_like(mask)))


def test_images_that_do_not_fit_are_refused():
    a, _ = pair()
    for function in (psnr, ssim, noise_sigma):
        with pytest.raises(ShapeError):
            function(a, a[:-1])
        with pytest.raises(ShapeError):
            function(a[..., 0], a[..., 0])
    with pytest.raises(ShapeError, match="mask"):
        psnr(a, a, np.ones((3, 3), bool))


@pytest.mark.parametrize(
    ("height", "width", "noise"), [(40, 56, 0.1), (13, 200, 0.5), (3, 4, 0.2), (64, 64, 0.001), (130, 20, 0.1)]
)
def test_ssim_equals_kornia_with_zero_padding(height, width, noise):
    a, b = pair(1, height, width, noise)
    tensors = [functional.pad(torch.tensor(x, dtype=torch.float64).permute(2, 0, 1)[None], (5,) * 4) for x in (a, b)]
    expected = kornia.metrics.ssim(*tensors, 11, padding="valid", eps=0.0).mean().item()
    assert ssim(a, b) == pytest.approx(expected, abs=1e-12)


def test_ssim_equals_its_definition_at_one_pixel():
    a, b = (x.astype(float) for x in pair(2, 11, 11))
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()
    total = 0.0
    for y in range(11):
        for x in range(11):
            for c in range(3):
                stats = [0.0] * 5
                for j in range(11):
                    for i in range(11):
                        v, u = y + j - 5, x + i - 5
                        if 0 <= v < 11 and 0 <= u < 11:
                            p, q, w = a[v, u, c], b[v, u, c], taps[j] * taps[i]
                            stats = [s + w * t for s, t in zip(stats, (p, q, p * p, q * q, p * q), strict=True)]
                mp, mq, pp, qq, pq = stats
                top = (2 * mp * mq + 1e-4) * (2 * (pq - mp * mq) + 9e-4)
                total += top / ((mp * mp + mq * mq + 1e-4) * (pp - mp * mp + qq - mq * mq + 9e-4))
    assert ssim(a, b) == pytest.approx(total / 363, abs=1e-12)


def test_ssim_is_one_for_equal_images_and_symmetric():
    a, b = pair(3)
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-12)
    assert ssim(a, b) < 1


@pytest.mark.parametrize("sigma", [0.002, 0.01, 0.05])
@pytest.mark.parametrize("moving", [0.0, 0.25])
def test_noise_is_found_in_spite_of_motion(sigma, moving):
    rng = np.random.default_rng(4)
    scene = rng.random((100, 120, 3)) * 0.5 + 0.2
    first, second = (scene + sigma * rng.normal(size=scene.shape) for _ in range(2))
    second[: int(100 * moving)] = rng.random((int(100 * moving), 120, 3))
    # Outliers shift the median of the rest a little; a quarter of them is worth less than 45 per cent.
    assert noise_sigma(first, second) == pytest.approx(sigma, rel=0.03 if moving == 0 else 0.45)


def test_a_change_of_exposure_is_no_noise():
    rng = np.random.default_rng(5)
    scene = rng.random((60, 60, 3))
    assert noise_sigma(scene, scene + 0.2) == pytest.approx(0, abs=1e-7)


def brute_dilation(mask, radius):
    out = np.zeros_like(mask)
    for y, x in np.argwhere(mask):
        out[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1] = True
    return out


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(0, 0.1))
def test_moving_mask_equals_its_definition(seed, sigma):
    rng = np.random.default_rng(seed)
    first = rng.random((9, 14, 3))
    image = first + rng.choice([0, 0, 0, 0, 0.02, 0.03, -0.2], size=first.shape)
    moved = (np.abs(image - first) > max(4 * 2**0.5 * sigma, 6 / 255)).any(-1)
    assert np.array_equal(moving_mask(image, first, sigma), brute_dilation(moved, 2))


@pytest.mark.parametrize("sigma", [0.0, 0.004, 0.02, 0.1])
def test_noise_alone_hardly_moves(sigma):
    rng = np.random.default_rng(6)
    first, image = (0.5 + sigma * rng.normal(size=(120, 160, 3)) for _ in range(2))
    assert moving_mask(image, first, sigma).mean() < 0.02


def test_a_frozen_scene_loses_on_moving_pixels():
    rng = np.random.default_rng(7)
    first = rng.random((60, 80, 3))
    truth = first.copy()
    truth[10:20, 10:20] = rng.random((10, 10, 3))
    assert psnr_moving(first, truth, first, 0.0) < psnr(first, truth) - 10
    assert psnr_moving(truth, truth, first, 0.0) == math.inf
    assert math.isnan(psnr_moving(first, first, first, 0.0))


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=50), st.integers(0, 1000))
def test_slope_equals_polyfit(values, start):
    frames = list(range(start, start + len(values)))
    assert slope_per_100(frames, values) == pytest.approx(100 * np.polyfit(frames, values, 1)[0], rel=1e-6, abs=1e-6)


def test_slope_of_a_line_and_of_nothing():
    assert slope_per_100([1, 2, 5], [30.0, 29.9, 29.6]) == pytest.approx(-10)
    assert math.isnan(slope_per_100([3], [1.0]))
    assert math.isnan(slope_per_100([], []))


def test_peak_memory_grows_with_an_allocation():
    """In a process of its own: where much was once used, only more than that would show."""
    code = (
        "import numpy; from gsstream.metrics import peak_memory_mb; before = peak_memory_mb()\n"
        "block = numpy.ones(int((before + 60) * 1e6 / 8)); print(before, peak_memory_mb())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    before, after = map(float, done.stdout.split())
    assert before > 10
    assert before + 50 < after < 2 * before + 120


KINDS = pytest.mark.parametrize("kind", [np.float32, np.float64])


@KINDS
@given(size=st.integers(1, 600), seed=st.integers(0, 999), few=st.booleans())
def test_median_is_numpys(kind: type, size: int, seed: int, few: bool) -> None:
    """To the bit, because thresholds are compared with it."""
    rng = np.random.default_rng(seed)
    values = (rng.integers(-2, 3, size) / 255 if few else rng.normal(size=size)).astype(kind)
    found, wanted = median(values), np.median(values)
    assert (found, found.dtype) == (wanted, wanted.dtype)
    deviation = np.median(np.abs(values - wanted))
    assert (median_deviation(values), median_deviation(values).dtype) == (deviation, deviation.dtype)


@KINDS
@pytest.mark.parametrize("shape", [(1,), (4, 1), (3, 5, 3), (60, 80, 3)])
def test_median_of_a_table_leaves_it_alone(kind: type, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(1).normal(size=shape).astype(kind)
    before = values.copy()
    assert median(values) == np.median(values)
    assert median_deviation(values) == np.median(np.abs(values - np.median(values)))
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("place", [0, 3, 8, 9])
@pytest.mark.parametrize("size", [10, 11])
def test_median_of_what_is_not_finite(size: int, place: int) -> None:
    values = np.arange(float(size))
    values[place] = np.inf
    assert median(values) == np.median(values)
    values[place] = np.nan
    assert np.isnan(median(values))
    assert np.isnan(median_deviation(values))
