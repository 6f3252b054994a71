"""The world frame is free: a recording moved, scaled and turned at will gives the same stream, up to chance."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import pytest
from early_densify import densifying
from similar_worlds import Moved, encode, world

from gsstream.core.world import IDENTITY, World
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.fit import constants
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.open import open_source
from gsstream.recipe.load import resolve_recipe

SOURCE = "synthetic:frames=3&views=6&width=40&height=30&supersample=1&motion=3"
SMALL = {  # hold reads no setting of later frames
    "first_frame.max_iterations": 80,
    "first_frame.points": "recording",
}
METHODS = ("s2gs-edge", "dense", "hold")
SEEDS = (0, 1, 2)
#: Without a shift float64 is exact to 1e-15, and cameras and points come out to the same bits.
EXACT = {"x 1e-6, turned": world(1e-6, turn=6), "x 1e9, turned": world(1e9, turn=7)}
SHIFTED = {
    "UTM": world(offset=(5e5, 5.2e6, 300)),
    "x 1e-6, turned, moved by 1e7": world(1e-6, (10, -10, 10), 8),
    "x 1e9, turned, moved by 1e7": world(1e9, (1e16, 0, -1e16), 9),
}


@pytest.fixture(autouse=True, scope="module")
def many_seeds_that_grow() -> Iterator[None]:
    with densifying(50, 20), pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "PIXELS_PER_SEED", 5)
        yield


@functools.cache
def found(method: str, where: World, seed: int = 0, to_file_coordinates: bool = False) -> tuple[dict[str, float], str]:
    catalog = load_catalog()
    epochs = {} if method == "hold" else {"stream.epochs": 2}
    sets = [("--set", f"{key}={value}") for key, value in {**SMALL, **epochs, "seed": seed}.items()]
    parts = assemble(resolve_recipe(method, catalog.recipe_path, (), sets), catalog)
    moved = Moved(open_source(SOURCE), where)
    return encode(parts, CanonicalSource(moved, IDENTITY if to_file_coordinates else recording_similarity(moved)))


def numbers(result: tuple[dict[str, float], str]) -> np.ndarray:
    """PSNR of frame 0, PSNR after it, on moving pixels, dB; logarithm of the bytes of key packet and deltas."""
    values = result[0]
    return np.array([values["psnr_0"], values["psnr"], values["psnr_moving"], np.log(values["key_kb"])])


@pytest.mark.parametrize("method", METHODS)
def test_every_world_gives_the_same_quality(method):
    seeds = np.stack([numbers(found(method, IDENTITY, seed)) for seed in SEEDS])
    assert seeds[0, 0] > 15, "frame 0 shows the scene"
    # Three seeds say little of a spread; differences below these are chance in any case.
    spread = np.maximum(np.ptp(seeds, axis=0), [0.3, 0.3, 0.4, 0.03])
    for name, where in {**EXACT, **SHIFTED}.items():
        away = numbers(found(method, where)) - seeds.mean(0)
        assert (np.abs(away) <= 1.5 * spread).all(), f"{name}: {away} beside a spread of {spread}"


@pytest.mark.parametrize("method", METHODS)
def test_turned_and_scaled_worlds_give_the_same_bits(method):
    digests = {name: found(method, where)[1] for name, where in EXACT.items()}
    assert set(digests.values()) == {found(method, IDENTITY)[1]}, digests


def test_coordinates_of_the_files_would_have_lost_quality():
    """That the test above can fail: the same recording without a world of its own."""
    far = numbers(found("hold", SHIFTED["UTM"], to_file_coordinates=True))
    assert far[0] < numbers(found("hold", SHIFTED["UTM"]))[0] - 1
