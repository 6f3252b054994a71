"""What must hold exactly: threads, tile masks, compact rows, extremes."""

from __future__ import annotations

import numpy as np
import pytest
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH, as_splats, equal_bits, random_splats, rasterizer, upstream
from gsstream_cpu_render.arrays import mask_shape
from gsstream_cpu_render.rasterizer import NumpyRasterizer, render_numpy


def masked_pixels(mask: np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.repeat(np.repeat(mask, 16, 0), 16, 1)[:height, :width].astype(bool)


def random_mask(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed).random(mask_shape(width, height)) < 0.5


def test_a_used_rasteriser_forgets_nothing_into_the_next_frame() -> None:
    v_image, v_alpha = upstream(1)
    used = rasterizer()
    for n, coefficients in ((300, 16), (5, 1), (120, 9)):
        splats = random_splats(n, n, coefficients)
        fresh = rasterizer()
        assert equal_bits(used.forward(splats), fresh.forward(splats))
        assert equal_bits(used.backward(v_image, v_alpha), fresh.backward(v_image, v_alpha))


@pytest.mark.parametrize("seed", range(4))
def test_tile_mask_equals_full_on_active_tiles(seed: int) -> None:
    splats = random_splats(150, seed, 4, opaque=seed % 2 == 1)
    mask = random_mask(seed)
    pixels = masked_pixels(mask)
    full, full_transmittance = rasterizer().forward(splats)
    image, transmittance = np.full((HEIGHT, WIDTH, 3), 7.0, np.float32), np.full((HEIGHT, WIDTH), 8.0, np.float32)
    subject = rasterizer()
    subject.forward(splats, tile_mask=mask, image=image, transmittance=transmittance)
    assert np.array_equal(image[pixels], full[pixels])
    assert np.array_equal(transmittance[pixels], full_transmittance[pixels])
    assert (image[~pixels] == 7.0).all()
    assert (transmittance[~pixels] == 8.0).all()


def test_masked_gradient_is_that_of_an_upstream_gradient_that_vanishes_elsewhere() -> None:
    splats = random_splats(150, 2, 4)
    mask = random_mask(2)
    v_image, v_alpha = upstream(2)
    masked, full = rasterizer(), rasterizer()
    masked.forward(splats, tile_mask=mask)
    full.forward(splats)
    pixels = masked_pixels(mask)
    got = masked.backward(v_image, v_alpha)
    want = full.backward(
        np.where(pixels[..., None], v_image, 0).astype(np.float32), np.where(pixels, v_alpha, 0).astype(np.float32)
    )
    for name, g, w in zip(got._fields, got, want, strict=True):
        np.testing.assert_allclose(g, w, rtol=0, atol=2e-6 * max(1.0, float(np.abs(w).max())), err_msg=name)


def test_an_empty_mask_renders_nothing() -> None:
    subject = rasterizer()
    image = np.full((HEIGHT, WIDTH, 3), 7.0, np.float32)
    subject.forward(random_splats(50, 0, 1), tile_mask=np.zeros(mask_shape(WIDTH, HEIGHT), bool), image=image)
    assert (image == 7.0).all()
    assert all((g == 0).all() for g in subject.backward(*upstream(0)))


def test_compact_rows_are_the_visible_rows_of_the_dense_gradient() -> None:
    splats = random_splats(200, 3, 9)
    splats.means[::2, 2] -= 50  # half of them behind the camera
    subject = rasterizer()
    subject.forward(splats)
    dense = subject.backward(*upstream(3))
    compact, rows = subject.backward(*upstream(3), compact=True), subject.visible_rows()
    assert 0 < len(rows) <= 100
    assert (np.diff(rows.astype(int)) > 0).all()
    unseen = np.setdiff1d(np.arange(200), rows)
    for whole, part in zip(dense, compact, strict=True):
        assert np.array_equal(whole[rows], part)
        assert (whole[unseen] == 0).all()


def test_backward_of_the_cache_is_the_means2d_part() -> None:
    subject, splats = rasterizer(), random_splats(80, 4, 4)
    subject.forward(splats)
    v_image, _ = upstream(4)
    assert np.array_equal(subject.backward_cached(splats, v_image)[0], subject.backward(v_image).means2d)


@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_rows_that_a_gradient_reaches_are_those_of_the_whole(share: float) -> None:
    subject, splats = rasterizer(), random_splats(300, 6, 4)
    subject.forward(splats)
    v_image = upstream(6)[0] * (np.random.default_rng(6).random((HEIGHT, WIDTH, 1)) < share).astype(np.float32)
    rows, gradient = subject.backward_cached_rows(splats, v_image)
    whole = subject.backward_cached(splats, v_image)[0]
    assert np.all(np.diff(rows) > 0)
    assert np.array_equal(gradient, whole[rows])
    assert not np.delete(whole, rows, 0).any()
    assert (len(rows) > 0) == (share > 0)


def test_nan_upstream_reaches_the_gradient() -> None:
    # A tile whose upstream gradient is zero is skipped; NaN must not count as zero.
    subject = rasterizer()
    subject.forward(random_splats(80, 4, 1))
    v_image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    v_image[20, 20] = np.nan
    assert np.isnan(subject.backward(v_image).means).any()


def axis_camera() -> tuple[np.ndarray, np.ndarray]:
    viewmat, K = np.eye(4), np.array([[60.0, 0, 20.0], [0, 60.0, 18.0], [0, 0, 1]])
    viewmat[2, 3] = 4
    return viewmat, K


@pytest.mark.parametrize("size", [(33, 17), (18, 16), (32, 16), (70, 33)])
def test_image_is_a_window_of_a_larger_one(size: tuple[int, int]) -> None:
    splats = random_splats(150, 5, 1)
    splats.means[:, :2] = 0.0  # on the axis, where the limits of the Jacobian, which depend on the size, do not bite
    small = NumpyRasterizer(*axis_camera(), *size, BACKGROUND).forward(splats)[0]
    large = NumpyRasterizer(*axis_camera(), 96, 96, BACKGROUND).forward(splats)[0]
    assert (small != np.array(BACKGROUND, np.float32)).any()
    assert np.array_equal(small, large[: size[1], : size[0]])


@pytest.mark.parametrize("log_scale", [15.0, 30.0, 80.0, 1e6])
def test_huge_gaussians_cover_everything(log_scale: float) -> None:
    splats = as_splats(
        [[0.1, -0.2, 0.3]], [[1, 0.2, 0.1, 0.3]], [[log_scale] * 3], [0.0], [[[1.0, 0.0, -1.0]]], np.zeros((1, 0, 3))
    )
    subject = rasterizer()
    image, transmittance = subject.forward(splats)
    np.testing.assert_allclose(transmittance, 0.5, atol=1e-6)
    assert np.ptp(image[..., 0]) < 1e-6
    assert all(np.isfinite(g).all() for g in subject.backward(*upstream(0)))


@pytest.mark.parametrize("log_scale", [-30.0, -1e6])
def test_vanishing_gaussians_keep_the_blur(log_scale: float) -> None:
    splats = random_splats(20, 6, 1)
    splats.scales[:] = log_scale
    subject = rasterizer()
    _, transmittance = subject.forward(splats)
    assert 0 < transmittance.min() < 1
    assert all(np.isfinite(g).all() for g in subject.backward(*upstream(0)))


@pytest.mark.parametrize("distance", [1e6, 1e12, 1e18, 3e38])
def test_far_away_means(distance: float) -> None:
    splats = random_splats(30, 7, 4)
    splats.means[::2] = np.array([distance, -distance, distance], np.float32)
    subject = rasterizer()
    image, _ = subject.forward(splats)
    assert np.isfinite(image).all()
    assert all(np.isfinite(g).all() for g in subject.backward(*upstream(0)))


def test_gaussian_counts_only_beyond_the_near_plane() -> None:
    splats = as_splats([[0.0, 0.0, 1.0]], [[1, 0, 0, 0]], [[-2.0] * 3], [2.0], [[[1.0, 1.0, 1.0]]], np.zeros((1, 0, 3)))
    matrices = np.eye(4), np.array([[30.0, 0, 10], [0, 30.0, 10], [0, 0, 1]])
    for near, seen in ((0.99, True), (1.0, False), (1.5, False)):
        _, transmittance = NumpyRasterizer(*matrices, 20, 20, BACKGROUND, near).forward(splats)
        assert bool((transmittance < 1).any()) is seen


def test_render_numpy_takes_any_float_layout() -> None:
    splats = random_splats(60, 8, 4)
    want = NumpyRasterizer(*axis_camera(), 40, 36).forward(splats)[0]
    got = render_numpy([np.asfortranarray(a.astype(np.float64)) for a in splats], *axis_camera(), 40, 36)
    assert np.array_equal(got, want)


def test_memory_is_reported_and_grows_with_the_scene() -> None:
    subject = rasterizer()
    subject.forward(random_splats(10, 0, 1))
    small = subject.memory_bytes()
    subject.forward(random_splats(20_000, 0, 1))
    assert subject.memory_bytes() - small > 64 * 15_000
