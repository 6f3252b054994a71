"""A lamp is told from everything else that changes pictures: by pictures whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsstream.core.changes import Light
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import to_bytes
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.lamp import in_light, switched, with_lamp
from gsstream.metrics import psnr
from gsstream.player.render import render
from gsstream.testing.cases import rig
from gsstream.testing.method_driver import _before, fit_fixture

VIEWS, HEIGHT, WIDTH = 5, 96, 128


def room(seed: int = 0, views: int = VIEWS) -> FloatArray:
    """Pictures [V, H, W, 3] of blocks between 0.05 and 0.7."""
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.05, 0.7, (views, HEIGHT // 8, WIDTH // 8, 3))
    return np.asarray(np.kron(blocks, np.ones((1, 8, 8, 1))), np.float32)


def parts(light: float = 1.0) -> Assembly:
    assembly = fit_fixture().work._assembly
    stream = assembly.recipe.stream.model_copy(update={"light": light})
    return replace(assembly, recipe=assembly.recipe.model_copy(update={"stream": stream}))


def found(before: Any, now: Any, light: float = 1.0) -> tuple[float, float, float] | None:
    lamp = switched(parts(light), state(before), frame(now))
    return None if lamp is None else lamp.factor


def frame(images: Any) -> Frame:
    return Frame(1, 0.0, images, rig(len(images)))


def state(images: Any) -> StreamState:
    return StreamState(None, None, previous=frame(images))  # type: ignore[arg-type]


@pytest.mark.parametrize("stored", [lambda images: images, to_bytes], ids=["float32", "uint8"])
@pytest.mark.parametrize("noise", [0.0, 2.5])
@pytest.mark.parametrize("factor", [(1.3,) * 3, (0.4,) * 3, (1.0, 1.0, 0.7), (1.4, 0.8, 1.0), (3.0,) * 3, (1.06,) * 3])
def test_the_factor_is_found_to_half_a_percent_and_in_noise_to_more(
    factor: tuple[float, ...], noise: float, stored: Any
) -> None:
    """Also where pixels are cut off at 255, and with the noise of a camera."""
    rng = np.random.default_rng(1)
    before, now = (
        stored(np.clip(images + noise / 255 * rng.normal(size=images.shape), 0, 1).astype(np.float32))
        for images in (room(), room() * np.float32(factor))
    )
    np.testing.assert_allclose(found(before, now), factor, rtol=0.015 if noise else 0.005)
    assert found(before, now, light=0.0) is None


def test_a_channel_that_is_dark_takes_the_factor_of_the_others() -> None:
    """Of a room in amber light: it has hardly any blue."""
    amber = room() * np.array([1, 0.6, 0.03], np.float32)
    np.testing.assert_allclose(found(amber, amber * np.float32(1.3)), 1.3, rtol=0.005)
    assert found(room(), room() * np.array([1, 1, 0.02], np.float32)) is None


def moved(share: float) -> FloatArray:
    """The room, in which other things stand in a share of every picture."""
    images, other = room(), room(9)
    images[:, :, : round(WIDTH * share)] = other[:, :, : round(WIDTH * share)]
    return images


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_what_moves_meanwhile_does_not_hide_it(share: float) -> None:
    np.testing.assert_allclose(found(room(), moved(share) * np.float32(1.3)), 1.3, rtol=0.005)


def one_camera(images: FloatArray, factor: float, cameras: int = 1) -> FloatArray:
    images = images.copy()
    images[:cameras] *= np.float32(factor)
    return images


NOISY = np.clip(room() + np.random.default_rng(2).normal(size=room().shape) * 4 / 255, 0, 1).astype(np.float32)
NONE = {
    "nothing": room(),
    "the noise of a camera": NOISY,
    "a slow dimming, which the colours follow": room() * np.float32(0.99),
    "one camera of five": one_camera(room(), 1.5),
    "half of the cameras": one_camera(room(), 1.5, 2),
    "three of five": one_camera(room(), 1.5, 3),
    "other pictures altogether": room(7),
    "a cut to white": np.ones_like(room()),
    "things that move in a third": moved(0.3),
    "things that move in most": moved(0.8),
}


@pytest.mark.parametrize("name", NONE)
def test_nothing_else_is_a_lamp(name: str) -> None:
    assert found(room(), NONE[name]) is None


def test_one_camera_has_no_say_and_two_must_agree() -> None:
    for views, lamp in ((1, False), (2, True)):
        before = room(views=views)
        assert (found(before, before * np.float32(1.3)) is not None) == lamp
    assert found(room(views=2), one_camera(room(views=2), 1.3)) is None


def test_pictures_too_small_to_tell_say_nothing() -> None:
    small = room()[:, :4, :4]
    assert found(small, small * np.float32(1.3)) is None


def test_a_flash_leaves_what_the_next_looks_compare_with_as_it_was() -> None:
    """Pictures that are cut off in the flash would be darker afterwards than the room is."""
    _, step = _before()
    player = step.state.player
    known = replace(step.state, player=replace(player, meta=replace(player.meta, background=(0.5, 0.25, 0.125))))
    bright = in_light(known, Light((2.0, 2.0, 2.0)))
    back = in_light(replace(bright, previous=known.previous), Light((0.5, 0.5, 0.5)))
    assert bright.lit is not None
    assert back.lit is not None
    assert (bright.lit.lamps, back.lit.lamps) == ((2.0,) * 3, (1.0,) * 3)
    assert np.array_equal(back.lit.pixels, bright.lit.pixels)
    assert (bright.player.meta.background, back.player.meta.background) == ((1.0, 0.5, 0.25), (0.5, 0.25, 0.125))
    stored = known.previous.images
    assert bright.previous.images.dtype == stored.dtype
    top = 255 if stored.dtype == np.uint8 else 1.0
    np.testing.assert_array_equal(bright.previous.images, np.minimum(2.0 * stored, top))
    assert bright.previous.images.max() == top
    assert (bright.session, bright.resident) == (None, None)
    assert known.player.meta.background == (0.5, 0.25, 0.125)


@pytest.mark.parametrize("dark", [0.0, 0.01, 0.1])
def test_a_room_goes_dark_and_when_the_light_is_back_it_is_as_it_was(dark: float) -> None:
    """Regression: what had gone dark was shown bright, because nothing changed any more, and bright again by pieces."""
    world = "synthetic:frames=7&views=4&width=64&height=48&supersample=1&static=1"
    settings = {"first_frame.max_iterations": 60, "first_frame.max_points": 600, "stream.epochs": 2}
    told, quality, means = [], [], []
    with open_recording(world) as source:
        encoder = encoder_for("s2gs-edge", source, settings)
        for index, light in enumerate((1.0, 1.0, dark, dark, 1.0, 1.0, 1.0)):
            now = source.frame(index)
            images = to_bytes(now.images * np.float32(light))
            made = encoder.encode(replace(now, images=images))
            told += [index] if "lamp" in made.metrics else []
            player = made.state.player
            shown = [
                np.clip(render(player.gaussians, now.cameras, view, background=player.meta.background), 0, 1)
                for view in range(4)
            ]
            means.append(255 * np.mean(shown))
            truths = images.astype(np.float32) / 255
            quality.append(np.mean([psnr(*pair) for pair in zip(shown, truths, strict=True)]))
    assert told == [2, 4]
    assert max(abs(value - dark * means[1]) for value in means[2:4]) < 1.0
    assert min(quality[2:4]) > quality[1]
    assert min(quality[4:]) > quality[1] - 0.2


def test_a_factor_that_does_not_fit_is_not_looked_for() -> None:
    before, now = state(room()), frame(room() * np.float32(1.3))
    for most in (16, 26):
        assert with_lamp(parts(), before, now, most, FrameLog()).light is None


def test_no_key_packet_is_made_in_the_dark() -> None:
    """Its grid would leave little of the colours; where the light is back there is one, of the room as it was."""
    world = "synthetic:frames=7&views=4&width=48&height=36&supersample=1&static=1"
    settings = {"first_frame.max_iterations": 20, "first_frame.max_points": 300, "stream.epochs": 1}
    with open_recording(world) as source:
        encoder = encoder_for("s2gs-edge", source, {**settings, "codec.key_interval": 2})
        made = []
        for index, light in enumerate((1.0, 1.0, 0.02, 0.02, 0.02, 1.0, 1.0)):
            now = source.frame(index)
            made.append(encoder.encode(replace(now, images=to_bytes(now.images * np.float32(light)))))
    assert [step.status == "key" for step in made] == [True, False, False, False, False, True, False]
    assert [step.metrics.get("key_postponed") for step in made[2:5]] == ["period: the light is off"] * 3
    first, last = (step.state.player.gaussians.sh0 for step in (made[0], made[-1]))
    assert np.abs(np.sort(first, 0) - np.sort(last, 0)).mean() < 0.05
