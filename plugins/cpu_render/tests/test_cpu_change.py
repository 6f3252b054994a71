"""Means over blocks and changed tiles: against numpy's own sums, and in numpy as in torch, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsstream_cpu_render.change import CpuChange, _VoteCache, block_means, block_sigma, changed_blocks, difference_means
from gsstream_cpu_render.renderer import CpuRenderer
from hypothesis import given
from hypothesis import strategies as st

from gsstream.backend import ChangeRule
from gsstream.core.storage import packed, unpacked
from gsstream.input.recordings.open import open_source
from gsstream.parts.backend import change as torch_change
from gsstream.parts.backend.change import Change, find_change
from gsstream.testing import rig


@pytest.mark.parametrize("height", [1, 3, 4, 5, 8, 11, 240])
@pytest.mark.parametrize("width", [1, 2, 4, 7, 12, 317])
def test_blocks_at_the_border_average_the_pixels_they_have(height: int, width: int) -> None:
    picture = np.random.default_rng(height).normal(size=(height, width, 3)).astype(np.float32)
    starts = np.arange(0, height, ChangeRule.BLOCK), np.arange(0, width, ChangeRule.BLOCK)
    sums = np.add.reduceat(np.add.reduceat(picture, starts[0], 0), starts[1], 1)
    sizes = [np.minimum(ChangeRule.BLOCK, n - s) for n, s in zip((height, width), starts, strict=True)]
    np.testing.assert_array_equal(block_means(picture), sums / np.outer(*sizes)[..., None])


def sigma_by_hand(means: np.ndarray) -> float:
    """Both estimates in full, with numpy's median."""
    spread = ChangeRule.MAD_TO_SIGMA * np.median(np.abs(means - np.median(means)))
    second = [means[:-2] - 2 * means[1:-1] + means[2:], means[:, :-2] - 2 * means[:, 1:-1] + means[:, 2:]]
    values = np.abs(np.concatenate([part.ravel() for part in second]))
    rough = (
        ChangeRule.MOST_OF_ROUGHNESS * ChangeRule.MAD_TO_SIGMA * np.median(values) / np.sqrt(6)
        if values.size
        else np.inf
    )
    return float(min(max(min(spread, rough), ChangeRule.LEAST_SIGMA), ChangeRule.MOST_SIGMA))


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
    assert block_sigma(means) == sigma_by_hand(means) == float(torch_change.block_sigma(torch.from_numpy(means)))
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


@pytest.mark.parametrize("kind", [Change, CpuChange])
@given(rows=st.integers(1, 5), columns=st.integers(1, 7), cut=st.integers(0, 15), seed=st.integers(0, 999))
def test_what_did_not_change_is_zero_and_the_rest_as_it_was(
    kind: type[Change], rows: int, columns: int, cut: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    tiles = rng.random((rows, columns)) < rng.random()
    height, width = 16 * rows - cut, 16 * columns - cut
    values = rng.normal(size=(height, width, 3)).astype(np.float32)
    change = kind(torch.from_numpy(tiles)[None], height, width)
    mask = np.kron(tiles, np.ones((16, 16), bool))[:height, :width, None]
    np.testing.assert_array_equal(change.only_changed(0, torch.from_numpy(values)).numpy(), np.where(mask, values, 0))
    now, before = (torch.from_numpy(rng.integers(0, 256, values.shape).astype(np.uint8)) for _ in range(2))
    exact = unpacked(now.numpy()) - unpacked(before.numpy())
    np.testing.assert_array_equal(change.difference(0, now, before).numpy(), np.where(mask, exact, 0))


THRESHOLD = 6.0


@given(
    height=st.integers(1, 90),
    width=st.integers(1, 90),
    noise=st.sampled_from([0.0, 0.5, 2.0, 300.0]),
    threshold=st.sampled_from([0.5, 1.0, 3.0, 6.0]),
    stored=st.sampled_from([(np.uint8, np.uint8), (np.float32, np.float32), (np.uint8, np.float32)]),
    seed=st.integers(0, 999),
)
def test_random_pictures_have_the_tiles_of_torch(
    height: int, width: int, noise: float, threshold: float, stored: tuple[type, type], seed: int
) -> None:
    """Levels of bytes make ties: a mean that is exactly the threshold must fall on the same side."""
    rng = np.random.default_rng(seed)
    before = rng.integers(0, 256, (height, width, 3)).astype(np.float64)
    now = np.clip(before + np.rint(noise * rng.normal(size=before.shape)), 0, 255)
    images = [
        [torch.from_numpy(levels.astype(kind) if kind is np.uint8 else (levels / 255).astype(kind))]
        for levels, kind in zip((before, now), stored, strict=True)
    ]
    assert torch.equal(CpuRenderer().find_change(*images, threshold).tiles, find_change(*images, threshold).tiles)


@pytest.mark.parametrize("uri", ["demo", "synthetic:frames=4&views=3&width=100&height=75&noise=0.01"])
@pytest.mark.parametrize("pixels", [1, 1 << 19])
def test_tiles_of_recordings_are_those_of_numpy(uri: str, pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """``pixels`` is the number of them from which several views are compared at a time."""
    monkeypatch.setattr("gsstream_cpu_render.change.THREADED_PIXELS", pixels)
    source = open_source(uri)
    first, second = source.frame(0), source.frame(3)
    for kind in (np.asarray, packed):
        images = [list(map(torch.from_numpy, kind(frame.images))) for frame in (first, second)]
        change = CpuRenderer().find_change(*images, THRESHOLD)
        assert torch.equal(change.tiles, find_change(*images, THRESHOLD).tiles)
        assert 0 < change.share < 1


@given(seed=st.integers(0, 999), moved=st.integers(0, 40), grown=st.booleans())
def test_votes_that_are_known_are_those_counted_anew(seed: int, moved: int, grown: bool) -> None:
    """Asked about some rows, then about others of the scene after a motion, or of one with another number of rows."""
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform([-4, -3, -1], [4, 3, 6], (40, 3)).astype(np.float32))
    change, cameras = CpuChange(torch.from_numpy(rng.random((3, 3, 4)) < 0.3), 40, 56), rig(3).scaled(56, 40)
    cache = _VoteCache()
    after = means.clone()
    after[rng.permutation(40)[:moved]] += 1.0
    if grown:
        after = torch.cat([after, after[:5] + 0.5])
    for some in (means, after, after):
        rows = torch.from_numpy(np.sort(rng.permutation(len(some))[: rng.integers(0, len(some) + 1)]))
        found = cache.of(some, rows, lambda asked: change.votes(asked, cameras))
        assert found.dtype == torch.float32
        assert found.tolist() == change.votes(some[rows], cameras).tolist()
