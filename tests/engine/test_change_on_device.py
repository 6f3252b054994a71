"""What is found in torch, on the device of the images, is what numpy finds on the processor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsstream.core.frame import Frame
from gsstream.engine.step.active import blocks, change_on_device
from gsstream.engine.step.active.change import Change, detect_changed_tiles
from gsstream.input.recordings.open import open_source
from gsstream.testing.cases import get_case

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
def test_tiles_of_recordings_are_those_of_numpy(uri: str) -> None:
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
