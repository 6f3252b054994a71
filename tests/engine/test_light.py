"""The light is followed: what is measured of pictures, what is asked of colours, and what of that is sent."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsstream.core.changes import Delta, Layout, Residual, Scene, apply_delta, sent_rows
from gsstream.core.gaussians import SH0
from gsstream.encode import open_recording
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.drift import Lit, cameras_apart, changes, drift, looked_at, tile_shares
from gsstream.engine.step.gains import camera_offsets
from gsstream.engine.step.light_symbols import STEP, light_symbols, with_light
from gsstream.packet import quantise_decoders
from tests.scenes import make_scene


def pictures(rng: np.random.Generator, change: float = 0.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Two views [2, 64, 80, 3] float32 of grey levels 60 to 180, brighter by ``change`` levels, with noise."""
    world = np.random.default_rng(seed).uniform(60, 180, (2, 64, 80, 3))
    return (world + change + rng.normal(0, noise, world.shape)).astype(np.float32) / np.float32(255)


def pixels(images: np.ndarray, stored: str = "float32", frame: int = 0, gains: np.ndarray | None = None) -> Lit:
    """What is looked at of pictures [V, H, W, 3] that are stored as bytes or not."""
    kept = np.rint(images * 255).astype(np.uint8) if stored == "uint8" else images
    return looked_at(frame, FrameImages(kept, torch.device("cpu")), gains)


@pytest.mark.parametrize("stored", ["uint8", "float32"])
@pytest.mark.parametrize(("change", "share"), [(0.0, 0.0), (2.0, 1.0), (-2.0, 1.0)])
def test_noise_is_no_drift_and_two_levels_of_light_are(stored: str, change: float, share: float) -> None:
    """The noise of a pixel is as large as the change; that of the mean of a grid's 16 pixels is half a level."""
    rng = np.random.default_rng(1)
    before, now = (pixels(pictures(rng, by, noise=2), stored) for by in (0, change))
    still, drifted = tile_shares(changes(before, now), levels=1)
    assert still == 1.0
    assert drifted == pytest.approx(share, abs=0.1)


def test_what_moved_is_not_asked_about_the_light() -> None:
    """In the left three tiles of five something else stands there; only the others have drifted."""
    rng = np.random.default_rng(2)
    before, now = pictures(rng), pictures(rng, 2)
    now[:, :, :48] = pictures(rng, seed=9)[:, :, :48]
    assert tile_shares(changes(pixels(before), pixels(now)), levels=1) == pytest.approx((2 / 5, 1.0))


@pytest.mark.parametrize("size", [(3, 5), (15, 40), (16, 16)])
def test_small_pictures_have_few_tiles_or_none(size: tuple[int, int]) -> None:
    before, now = np.zeros((1, *size, 3), np.float32), np.full((1, *size, 3), 4 / 255, np.float32)
    wanted = (1.0, 1.0) if size == (16, 16) else (0.0, 0.0)
    assert tile_shares(changes(pixels(before), pixels(now)), levels=1) == wanted


@pytest.mark.parametrize(("change", "due", "frame"), [(0.4, False, 0), (2.0, True, 0), (80.0, False, 5)])
def test_the_light_is_due_when_it_drifted_and_starts_anew_after_a_jump(change: float, due: bool, frame: int) -> None:
    """After a lamp nothing can be told from what moved: the next frames are compared with the present one."""
    rng = np.random.default_rng(3)
    before, now = pixels(pictures(rng)), pixels(np.minimum(pictures(rng, change), 1), frame=5)
    found = drift(before, now, levels=1)
    assert (found.is_due, found.lit.frame, found.apart) == (due, frame, ())


def rig_pictures(ratios: list[float], noise: float = 2.0, seed: int = 0) -> np.ndarray:
    """Pictures [V, 64, 80, 3] float32 of one grey wall per camera, times a factor each, with noise."""
    world = np.random.default_rng(0).uniform(60, 180, (len(ratios), 64, 80, 3))
    levels = world * np.reshape(ratios, (-1, 1, 1, 1)) + np.random.default_rng(seed).normal(0, noise, world.shape)
    return levels.astype(np.float32) / np.float32(255)


@pytest.mark.parametrize("stored", ["uint8", "float32"])
@pytest.mark.parametrize(
    ("ratios", "apart"),
    [
        ([1.0, 1.0, 1.0, 1.0], ()),
        ([0.9, 0.9, 0.9, 0.9], ()),
        ([1.0, 1.0, 0.98, 1.0], (2,)),
        ([0.96, 0.96, 0.98, 0.96], (2,)),
        ([1.02, 1.0, 0.98, 1.0, 1.0], (0, 2)),
        ([1.0, 0.8], ()),
        ([1.0], ()),
    ],
)
def test_a_camera_leaves_the_others_by_a_level_of_what_they_do(
    stored: str, ratios: list[float], apart: tuple[int, ...]
) -> None:
    """Light that all see alike is none of a camera's; of two cameras neither is most."""
    before = pixels(rig_pictures([1.0] * len(ratios), seed=1), stored)
    assert cameras_apart(changes(before, pixels(rig_pictures(ratios, seed=2), stored)), levels=1) == apart


@pytest.mark.parametrize("storage", [("uint8", "float32"), ("float32", "uint8")])
def test_a_gain_that_is_known_is_no_change(storage: tuple[str, str]) -> None:
    """Neither of the camera nor of the light, however the two pictures are stored, and whichever of them has it."""
    first, then = rig_pictures([1.0, 1.0, 1.0], noise=0), rig_pictures([1.0, 0.8, 1.0], noise=0)
    gains = np.array([[1, 1, 1], [0.8, 0.8, 0.8], [1, 1, 1]], np.float32)
    before, now = pixels(first, storage[0]), pixels(then, storage[1], frame=5, gains=gains)
    assert cameras_apart(changes(before, now), levels=1) == ()
    assert tile_shares(changes(before, now), levels=1) == (1.0, 0.0)
    assert tile_shares(changes(now, before), levels=1) == (1.0, 0.0)
    assert cameras_apart(changes(now._replace(gains=None), before), levels=1) == (1,)


def test_a_camera_before_which_half_a_picture_moves_is_not_apart() -> None:
    before, now = rig_pictures([1.0] * 4, seed=1), rig_pictures([1.0] * 4, seed=2)
    now[2, :, :32] = 0.9
    assert cameras_apart(changes(pixels(before), pixels(now)), levels=1) == ()


@pytest.mark.parametrize("size", [(3, 5), (15, 40)])
def test_of_pictures_without_a_tile_no_camera_is_apart(size: tuple[int, int]) -> None:
    before, now = np.zeros((4, *size, 3), np.float32), np.zeros((4, *size, 3), np.float32)
    now[1] = 0.5
    assert cameras_apart(changes(pixels(before), pixels(now)), levels=1) == ()


@pytest.mark.parametrize("shown", ["black", "white", "grey", "another place", "noise"])
@pytest.mark.parametrize("before_black", [False, True])
def test_a_camera_that_shows_something_else_is_not_apart(shown: str, before_black: bool) -> None:
    """A cable that fell out, a hand before the lens: no gain brings that back. Nor is one found when it ends."""
    place = rig_pictures([1.0] * 4, seed=1)
    other = place.copy()
    other[2] = {
        "black": np.float32(0),
        "white": np.float32(1),
        "grey": np.float32(0.2),
        "another place": 0.4 * rig_pictures([1.0], noise=30, seed=5)[0][::-1, ::-1],
        "noise": np.random.default_rng(3).uniform(0, 0.2, place.shape[1:]).astype(np.float32),
    }[shown]
    before, now = (other, place) if before_black else (place, other)
    assert cameras_apart(changes(pixels(before), pixels(now)), levels=1) == ()


def test_of_a_rig_in_the_dark_no_camera_is_apart() -> None:
    before = np.zeros((4, 32, 32, 3), np.float32)
    now = before.copy()
    now[3] = 0.02
    assert cameras_apart(changes(pixels(before), pixels(before)), levels=1) == ()
    assert cameras_apart(changes(pixels(before), pixels(now)), levels=1) == ()


def test_no_pass_is_due_in_the_demo_whatever_frames_are_compared() -> None:
    """Its light stays, and what moves in it is no light: so its packets hold no byte of any."""
    with open_recording("demo") as source:
        frames = [
            looked_at(i, FrameImages(source.frame(i).as_stored().images, torch.device("cpu")), None)
            for i in range(source.info.num_frames or 0)
        ]
    found = [drift(before, now, levels=1) for before in frames for now in frames]
    assert not any(each.is_due or each.apart for each in found)


def test_rows_and_cameras_share_what_is_asked_for_as_it_came_about() -> None:
    """Colours change by place and one camera drifts: both are found again, each where the change came about."""
    rng = np.random.default_rng(3)
    light = torch.from_numpy(rng.uniform(0, 5, (6, 40)) * (rng.random((6, 40)) < 0.6)).float()
    places = torch.from_numpy(rng.normal(size=(40, 3))).float()
    cameras = torch.zeros(6, 3)
    cameras[2] = torch.tensor([0.6, -0.3, 0.0])
    asked = light[:, :, None] * (places[None] + cameras[:, None])
    found = camera_offsets(asked.sum(1), asked.sum(0), light)
    torch.testing.assert_close(found, cameras, atol=1e-4, rtol=1e-4)
    left = (asked.sum(0) - light.T @ found) / light.sum(0)[:, None]
    torch.testing.assert_close(left, places, atol=1e-3, rtol=1e-3)


def test_a_row_that_no_camera_sees_asks_for_nothing() -> None:
    light = torch.tensor([[1.0, 0.0], [2.0, 0.0]])
    asked = torch.zeros(2, 2, 3)
    assert torch.equal(camera_offsets(asked.sum(1), asked.sum(0), light), torch.zeros(2, 3))


def test_symbols_are_the_best_at_their_price() -> None:
    """Without a price they are the nearest multiples; with one they lose error and save bits; in the end all are 0."""
    rng = np.random.default_rng(4)
    grey = rng.uniform(-3, 3, 500)
    change, worth = np.outer(grey, np.ones(3) / 3**0.5) * STEP, rng.uniform(1, 50, 500)
    symbols, direction = light_symbols(change, worth, price=0)
    np.testing.assert_allclose(np.linalg.norm(direction), STEP, rtol=1e-6)
    assert np.array_equal(symbols, np.rint(grey * np.sign(direction.sum())))
    counts, errors = [], []
    for price in (0, 1e-2, 1e-1, 1, 1e9):
        symbols, direction = light_symbols(change, worth, price=price)
        counts.append(np.count_nonzero(symbols))
        errors.append(float((worth[:, None] * (change - symbols[:, None] * direction) ** 2).sum()))
    assert counts == sorted(counts, reverse=True)
    assert errors == sorted(errors)
    assert counts[-1] == 0


def layout_of(counts: list[int]) -> Layout:
    number = sum(counts)
    return Layout(np.array(counts, np.int32), np.zeros(number, np.uint8), np.ones(1, np.float32))


def residual_of(layout: Layout, gates: list[int], names: tuple[str, ...], step: float) -> Residual | None:
    """Gates of 10 levels with random symbols of the named attributes; None without an open gate."""
    rng, opened = np.random.default_rng(5), np.array(gates, np.uint8)
    if not opened.any():
        return None
    rows = len(sent_rows(layout, opened))
    widths = {"means": 3, "sh0": 2}
    symbols = {name: rng.integers(-3, 4, (rows, widths[name])).astype(np.int32) for name in names}
    decoders = quantise_decoders({"sh0": rng.normal(size=(2, 3))} if "sh0" in names else {})
    return Residual(opened, 10, symbols, dict.fromkeys(names, step), decoders)


@pytest.mark.parametrize("gates", [[0, 0, 0, 0], [0, 10, 0, 4]])
@pytest.mark.parametrize("names", [("means",), ("sh0",), ("means", "sh0")])
@pytest.mark.parametrize("step", [1.0, 0.75])
def test_colours_behind_closed_gates_follow_and_the_residual_stays(
    gates: list[int], names: tuple[str, ...], step: float
) -> None:
    layout = layout_of([3, 2, 4, 1])
    scene = Scene(make_scene(10), layout)
    residual = residual_of(layout, gates, names, step)
    before = Delta().with_residual(residual)
    change = np.full((10, 3), 2 * STEP / 3**0.5)
    decoder = quantise_decoders({"sh0": np.ones((2, 3))})["sh0"]
    after = with_light(before, layout, change=change, worth=np.ones(10), price=0, decoder=decoder, step=step, levels=10)
    plain, lit = apply_delta(scene, before).gaussians, apply_delta(scene, after).gaussians
    closed = np.array(gates)[layout.node_of] == 0
    moved = (lit.sh0 - plain.sh0)[:, 0]
    np.testing.assert_allclose(moved[closed], change[closed], rtol=2e-3)  # decoders are sent in 16 bits
    np.testing.assert_allclose(moved[~closed], 0, atol=1e-6)
    for name in ("means", "quats", "scales", "opacities", "shN"):
        assert np.array_equal(getattr(lit, name), getattr(plain, name)), name


def test_nothing_is_sent_where_nothing_is_worth_its_bits() -> None:
    layout = layout_of([3, 2])
    small = np.full((5, 3), 0.1 / 255 / SH0)
    before = Delta()
    after = with_light(
        before, layout, change=small, worth=np.ones(5), price=0, decoder=np.ones((2, 3), np.float32), step=1, levels=1
    )
    assert after is before
