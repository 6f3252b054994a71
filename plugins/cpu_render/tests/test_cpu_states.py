"""A rasteriser takes these calls in these states; its incremental mode has the bits of the full path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cpu_scenes import HEIGHT, WIDTH, equal_bits, random_splats, rasterizer, rows_of, upstream, with_rows
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.rasterizer import NumpyRasterizer
from test_cpu_raster_properties import masked_pixels, random_mask

from gsstream.api import InputError

SPLATS = random_splats(60, 3, 4)
IDS = np.arange(2, 60, 5, dtype=np.uint32)
V_IMAGE = upstream(0)[0]
FORWARD, FREEZE = "expected a forward pass of the whole scene", "expected freeze"
PASS, ACTIVE = "expected a forward pass before", "expected a forward_active pass before"


def picture() -> tuple[Any, Any]:
    return np.zeros((HEIGHT, WIDTH, 3), np.float32), np.ones((HEIGHT, WIDTH), np.float32)


CALLS: dict[str, Callable[[NumpyRasterizer], object]] = {
    "forward": lambda r: r.forward(SPLATS),
    "backward": lambda r: r.backward(V_IMAGE),
    "freeze": lambda r: r.freeze(None, IDS),
    "forward_active": lambda r: r.forward_active(rows_of(SPLATS, IDS)),
    "backward_active": lambda r: r.backward_active(V_IMAGE),
    "update": lambda r: r.update(IDS, rows_of(SPLATS, IDS), *picture()),
    "backward_cached": lambda r: r.backward_cached(SPLATS, V_IMAGE),
    "contributing_in_cache": lambda r: r.contributing_in_cache(None),
    "forward_cached": lambda r: r.forward_cached(),
    "forget": lambda r: r.forget(),
    "free_scratch": lambda r: r.free_scratch(),
}
ANY = {"forward", "forget", "free_scratch"}
CACHED = ANY | {"freeze", "update", "backward_cached", "contributing_in_cache", "forward_cached"}
#: State: the calls that lead to it, and those it takes.
STATES = {
    "forgotten": (["forward", "forget"], CACHED),
    "cached": (["forward", "forward_cached"], CACHED),
    "cached by an update": (["forward", "freeze", "forward_active", "update"], CACHED),
    "cached, scratch shed": (["forward", "freeze", "free_scratch"], CACHED),
    "passed": (["forward"], CACHED | {"backward"}),
    "passed, looked at": (["forward", "backward", "contributing_in_cache", "backward_cached"], CACHED | {"backward"}),
    "frozen": (["forward", "freeze"], CACHED | {"forward_active"}),
    "frozen, pass forgotten": (["forward", "freeze", "forward_active", "forward_cached"], CACHED | {"forward_active"}),
    "active_passed": (["forward", "freeze", "forward_active"], CACHED | {"forward_active", "backward_active"}),
    "active_passed, looked at": (
        ["forward", "freeze", "forward_active", "backward_active", "contributing_in_cache", "backward_cached"],
        CACHED | {"forward_active", "backward_active"},
    ),
}  # fmt: skip
MESSAGES = {"backward": PASS, "backward_active": ACTIVE, "forward_active": FREEZE}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("state", STATES)
def test_a_state_takes_these_calls_and_no_others(state: str, call: str) -> None:
    subject = rasterizer()
    path, taken = STATES[state]
    for step in path:
        CALLS[step](subject)
    if call in taken:
        CALLS[call](subject)
        return
    with pytest.raises(InputError, match=f"{call}: {MESSAGES.get(call, FORWARD)}"):
        CALLS[call](subject)
    # A refusal changes nothing: the calls that the state takes still succeed.
    for other in sorted(taken - {"forward", "update", "freeze", "forget", "free_scratch", "forward_cached"}):
        CALLS[other](subject)


@pytest.mark.parametrize("call", ["backward", "freeze", "forward_active", "backward_active", "contributing_in_cache"])
def test_a_new_rasteriser_takes_none_that_needs_a_pass(call: str) -> None:
    with pytest.raises(InputError, match=f"{call}: {MESSAGES.get(call, FORWARD)}"):
        CALLS[call](rasterizer())


def test_a_pass_that_fails_leaves_the_state_before_it() -> None:
    subject = rasterizer()
    bad = rows_of(SPLATS, IDS)
    bad.means[1, 1] = np.nan
    subject.forward(SPLATS)
    subject.freeze(None, IDS)
    with pytest.raises(InputError, match="nan"):
        subject.forward_active(bad)
    with pytest.raises(InputError, match=ACTIVE):
        subject.backward_active(V_IMAGE)
    subject.forward_active(rows_of(SPLATS, IDS))  # frozen still
    whole = random_splats(60, 3, 4)
    whole.means[5, 0] = np.inf
    with pytest.raises(InputError, match="inf"):
        subject.forward(whole)
    for call in ("freeze", "update", "backward_cached"):
        with pytest.raises(InputError, match=FORWARD):
            CALLS[call](subject)


def some_ids(n: int, count: int, seed: int) -> np.ndarray:
    return np.sort(np.random.default_rng(seed).permutation(n)[:count]).astype(np.uint32)


def moved(rows: SplatArrays, seed: int, amount: float = 0.2) -> SplatArrays:
    rng = np.random.default_rng(seed)
    return SplatArrays(*((a + amount * rng.normal(size=a.shape)).astype(np.float32) for a in rows))


def rows_of_gradients(gradients: tuple[np.ndarray, ...], ids: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(g[ids] for g in gradients)


@pytest.mark.parametrize("seed", range(4))
def test_touched_only_changes_exactly_the_pixels_that_change(seed: int) -> None:
    splats, ids = random_splats(200, seed, 4), some_ids(200, 6, seed)
    splats.scales[:] -= 1.0
    subject = rasterizer()
    cached, cached_transmittance = subject.forward(splats)
    subject.freeze(None, ids)
    rows = moved(rows_of(splats, ids), seed, 0.5)
    image, transmittance = np.full_like(cached, np.nan), np.full_like(cached_transmittance, np.nan)
    subject.forward_active(rows, image=image, transmittance=transmittance, touched_only=True)
    gradients = subject.backward_active(*upstream(seed))
    full = rasterizer()
    want, want_transmittance = full.forward(with_rows(splats, ids, rows))
    untouched = np.isnan(transmittance)
    assert untouched.any()
    assert np.array_equal(want, np.where(untouched[..., None], cached, image))
    assert np.array_equal(want_transmittance, np.where(untouched, cached_transmittance, transmittance))
    assert equal_bits(gradients, rows_of_gradients(full.backward(*upstream(seed)), ids))


def test_forward_cached_renders_only_wanted_tiles() -> None:
    subject = rasterizer()
    want, _ = subject.forward(random_splats(100, 7, 1))
    mask = random_mask(7)
    image = np.full((HEIGHT, WIDTH, 3), 7.0, np.float32)
    subject.forward_cached(tile_mask=mask, image=image)
    pixels = masked_pixels(mask)
    assert np.array_equal(image[pixels], want[pixels])
    assert (image[~pixels] == 7.0).all()


def test_tiles_that_were_not_drawn_and_rows_that_are_not_frozen_are_refused() -> None:
    splats, ids = random_splats(20, 0, 1), some_ids(20, 5, 0)
    subject = rasterizer()
    subject.forward(splats, tile_mask=np.array([[1, 0, 0, 0]] * 3, bool))
    with pytest.raises(InputError, match="tile_mask has tiles that the cached forward pass did not cover"):
        subject.freeze(None, ids)
    subject.forward(splats)
    subject.freeze(None, ids)
    with pytest.raises(InputError, match="expected shape"):
        subject.forward_active(splats)


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (np.array([3, 3], np.uint32), "strictly ascending"),
        (np.array([4, 3], np.uint32), "got 3 at index 1"),
        (np.array([0, 20], np.uint32), "rows below 20, got 20"),
        (np.array([1, 2]), "expected uint32"),
        ([1, 2], "expected uint32"),
        (np.array([[1]], np.uint32), "expected uint32"),
    ],
)
def test_bad_active_ids(ids: np.ndarray, message: str) -> None:
    subject = rasterizer()
    subject.forward(random_splats(20, 0, 1))
    with pytest.raises(InputError, match=message):
        subject.freeze(None, ids)


@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_updates_of_few_blocks_leave_what_a_forward_of_the_scene_leaves(isa: str, opaque: bool, seed: int) -> None:
    """One small row after another: most blocks of a touched tile keep what was rendered of them, in another list.

    With opaque Gaussians pixels end early, so the place at which they did has to follow the list.
    """
    splats = random_splats(300, seed, 4, opaque=opaque)
    if opaque:
        splats.opacities[::3] = 9.0
    subject = rasterizer()
    picture = subject.forward(splats)
    for step in range(6):
        ids = some_ids(300, 1 + step % 2, 10 * seed + step)
        rows = moved(rows_of(splats, ids), 7 * seed + step)
        rows.scales[:] = -3.5  # a pixel or two wide
        subject.update(ids, rows, *picture)
        splats = with_rows(splats, ids, rows)
        fresh = rasterizer()
        assert equal_bits(picture, fresh.forward(splats))
        v_image = upstream(step)[0]
        assert equal_bits(subject.backward_cached(splats, v_image), fresh.backward_cached(splats, v_image))
        assert np.array_equal(subject.contributing_in_cache(None), fresh.contributing_in_cache(None))
