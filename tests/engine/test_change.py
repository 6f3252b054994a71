"""Means over blocks and changed tiles: against numpy's own sums, and in torch as in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.frame import Frame
from gsstream.core.storage import unpacked
from gsstream.engine.step.active import blocks, change_on_device
from gsstream.engine.step.active.blocks import (
    BLOCK,
    LEAST_SIGMA,
    MOST_OF_ROUGHNESS,
    MOST_SIGMA,
    block_means,
    block_sigma,
    changed_blocks,
    difference_means,
)
from gsstream.engine.step.active.change import Change, detect_changed_tiles
from gsstream.input.recordings.open import open_source
from gsstream.metrics.noise import MAD_TO_SIGMA
from gsstream.testing.cases import get_case


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
    np.testing.assert_array_equal(changed_blocks(np.zeros_like(difference), difference, 4.0), expected)


@given(height=st.integers(1, 140), width=st.integers(1, 40), noise=st.integers(0, 255), seed=st.integers(0, 999))
def test_blocks_of_bytes_are_those_of_exact_differences(height: int, width: int, noise: int, seed: int) -> None:
    """Sums of levels stay in range where a picture turns from black to white, and none is rounded."""
    rng = np.random.default_rng(seed)
    before = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    now = np.clip(before.astype(np.int64) + rng.integers(-noise, noise + 1, before.shape), 0, 255).astype(np.uint8)
    exact = (now.astype(np.float64) - before) / 255
    means = difference_means(before, now)
    np.testing.assert_allclose(means, block_means(exact), rtol=0, atol=1e-12)
    floats = difference_means(unpacked(before), unpacked(now))
    np.testing.assert_allclose(means, floats, rtol=0, atol=1e-6)


@given(rows=st.integers(1, 5), columns=st.integers(1, 7), cut=st.integers(0, 15), seed=st.integers(0, 999))
def test_what_did_not_change_is_zero_and_the_rest_as_it_was(rows: int, columns: int, cut: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tiles = rng.random((rows, columns)) < rng.random()
    height, width = 16 * rows - cut, 16 * columns - cut
    values = rng.normal(size=(height, width, 3)).astype(np.float32)
    change = Change(torch.from_numpy(tiles)[None], height, width)
    mask = np.kron(tiles, np.ones((16, 16), bool))[:height, :width, None]
    np.testing.assert_array_equal(change.only_changed(0, torch.from_numpy(values)).numpy(), np.where(mask, values, 0))
    now, before = (torch.from_numpy(rng.integers(0, 256, values.shape).astype(np.uint8)) for _ in range(2))
    exact = unpacked(now.numpy()) - unpacked(before.numpy())
    np.testing.assert_array_equal(change.difference(0, now, before).numpy(), np.where(mask, exact, 0))


THRESHOLD = 6.0


def pictures(kind: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(height * width)
    before = rng.random((height, width, 3), np.float32)
    noise = rng.normal(size=before.shape).astype(np.float32) / 255
    now = {"still": before, "noise": before + noise, "flash": before * 1.2, "moved": before + noise}[kind].copy()
    if kind == "moved":
        now[height // 3 : height // 2, width // 4 : width // 2] += 0.2
    return before, now


@pytest.mark.parametrize("size", [(64, 80), (37, 49), (3, 5), (16, 16), (9, 130)])
@pytest.mark.parametrize("kind", ["still", "noise", "flash", "moved"])
def test_blocks_noise_and_tiles_are_those_of_numpy(kind: str, size: tuple[int, int]) -> None:
    before, now = pictures(kind, *size)
    means, _ = change_on_device.block_means(torch.from_numpy(now - before))
    want = blocks.block_means(now - before)
    np.testing.assert_allclose(means.numpy(), want, atol=1e-7)
    assert float(change_on_device.block_sigma(means)) == pytest.approx(blocks.block_sigma(want), rel=1e-5)
    cameras = get_case("cloud").cameras.select([0]).scaled(size[1], size[0])
    frames = [Frame(index, 0.0, images[None], cameras) for index, images in enumerate((before, now))]
    change = detect_changed_tiles(*frames, THRESHOLD)
    assert change is not None
    found = change_on_device.change_on_device(torch.from_numpy(before), torch.from_numpy(now), THRESHOLD)
    assert torch.equal(found, change.tiles[0])
    assert kind != "moved" or size[0] <= 16 or bool(found.any())


@pytest.mark.parametrize("uri", ["demo", "synthetic:frames=4&views=3&width=100&height=75&noise=0.01"])
@pytest.mark.parametrize("pixels", [1, 1 << 19])
def test_tiles_of_recordings_are_those_of_numpy(uri: str, pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """``pixels`` is the number of them from which several views are compared at a time."""
    monkeypatch.setattr("gsstream.engine.step.active.change.THREADED_PIXELS", pixels)
    source = open_source(uri)
    first, second = source.frame(0), source.frame(3)
    change = detect_changed_tiles(first, second, THRESHOLD)
    assert change is not None
    for view, tiles in enumerate(change.tiles):
        images = (torch.from_numpy(frame.images[view]) for frame in (first, second))
        assert torch.equal(change_on_device.change_on_device(*images, THRESHOLD), tiles)
    assert 0 < change.share < 1


def test_votes_are_those_of_numpy() -> None:
    case = get_case("cloud")
    generator = torch.Generator().manual_seed(4)
    cameras = case.cameras.scaled(100, 75)
    change = Change(torch.rand(len(cameras), 5, 7, generator=generator) < 0.3, 75, 100)
    means = torch.cat([case.gaussians.means, 20 * torch.randn(300, 3, generator=generator)])
    found, want = change_on_device.votes_on_device(change, means, cameras), change.votes(means, cameras)
    # A centre on the border of a tile may fall on either side of it.
    assert int((found != want).sum()) <= 1
    assert len(torch.unique(want)) > 2
