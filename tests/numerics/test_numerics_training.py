"""Training at the extremes: bad pictures, blind cameras, flashes, spikes, and a thousand frames in which nothing moves.

The recording is the contract kit's: 32 x 24 pixels, three cameras; a few steps per frame.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import some

from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.engine.step.optimise import _Fit
from gsstream.input.recordings.open import open_source
from gsstream.metrics import psnr
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.residual.adam_state import MAX_GRADIENT, AdamState
from gsstream.testing.streaming_method import SOURCE, MethodUnderTest


@functools.cache
def begun(method: str = "s2gs") -> tuple[MethodUnderTest, Any, Frame]:
    """A method, its state after frame 0, and frame 0."""
    subject, frame = MethodUnderTest(method), open_source(SOURCE).frame(0)
    return subject, subject.begin(frame).state, frame


def shown(frame: Frame, index: int, change: Callable[[Any], Any]) -> Frame:
    """The same instant with changed pictures."""
    return replace(frame, index=index, images=np.clip(change(frame.images), 0, 1).astype(np.float32))


def quality(subject: MethodUnderTest, state: Any, frame: Frame) -> float:
    """Mean PSNR of the decoded scene on the training cameras."""
    values = []
    for view in range(len(frame.cameras)):
        with torch.no_grad():
            image = subject.assembly.renderer.render(state.gaussians, frame.cameras, view, subject.assembly.background)
        values.append(psnr(np.clip(image.image.numpy(), 0, 1), frame.images[view]))
    return float(np.mean(values))


def assert_sound(state: Any) -> None:
    for name, value in state.player.gaussians.items():
        assert np.isfinite(value).all(), name


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.01, 1.5, 255.0])
def test_a_corrupt_picture_is_refused_with_camera_frame_and_pixel(bad: float) -> None:
    _, _, frame = begun()
    images = frame.images.copy()
    images[1, 7, 9, 2] = bad
    images[2, 0, 0, 0] = bad
    name = frame.cameras.ids[1]
    with pytest.raises(ShapeError, match=rf"images of frame 4, camera '{name}': .* row 7, column 9, channel 2 \(1 of"):
        replace(frame, index=4, images=images).validate()
    replace(frame, images=np.float32(frame.images + 5e-5)).validate()  # what resampling leaves is no fault


@pytest.mark.parametrize("method", ["s2gs", "s2gs-paper", "dense"])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_black_or_white_frame_is_survived(level: float, method: str) -> None:
    subject, state, frame = begun(method)
    blank = shown(frame, 1, lambda images: np.full_like(images, level))
    step = subject.step(state, blank)
    assert_sound(step.state)
    after = subject.step(step.state, shown(frame, 2, lambda images: images))
    assert_sound(after.state)
    assert np.isfinite(quality(subject, after.state, frame))


def test_a_camera_that_sees_nothing_changes_nothing_for_the_others() -> None:
    subject, state, frame = begun()
    away = frame.cameras.viewmats.copy()
    away[1, :3] = np.diag([1.0, -1.0, -1.0]) @ away[1, :3]
    away[1, 2, 3] = -abs(away[1, 2, 3]) - 1000.0
    cameras = replace(frame.cameras, viewmats=away)
    cameras.validate()
    blind = replace(state, previous=replace(state.previous, cameras=cameras), session=None)
    step = subject.step(blind, replace(shown(frame, 1, FLASHES["upside down"]), cameras=cameras))
    assert_sound(step.state)
    assert step.metrics["iterations"] > 0


def test_a_thousand_still_frames_drift_by_nothing_and_cost_sixteen_bytes_each() -> None:
    subject, state, frame = begun()
    start, size = state, 0
    for index in range(1, 1001):
        step = subject.step(state, replace(frame, index=index))
        state, size = step.state, size + len(step.packet.data)
    assert size == 16_000
    for (name, before), (_, after) in zip(start.player.gaussians.items(), state.player.gaussians.items(), strict=True):
        assert np.array_equal(before, after), name
    assert state.previous.index == start.previous.index


def test_a_noisy_still_scene_does_not_drift() -> None:
    subject, state, frame = begun()
    rng = np.random.default_rng(0)
    first = quality(subject, state, frame)
    for index in range(1, 31):
        noise = rng.normal(0, 2 / 255, frame.images.shape)
        state = subject.step(state, shown(frame, index, lambda images, noise=noise: images + noise)).state
    assert_sound(state)
    assert quality(subject, state, frame) > first - 0.1


FLASHES = {
    "half as bright again": lambda images: images * 1.5,
    "a third darker": lambda images: images * 0.66,
    "white": np.ones_like,
    "black": np.zeros_like,
    "upside down": lambda images: images[:, ::-1],
}


def textured(index: int, noise: float = 0.01) -> Frame:
    """A picture with texture everywhere, and noise: its change by a flash is as spread as its texture."""
    _, _, frame = begun()
    y, x = np.mgrid[:24, :32]
    pattern = (0.45 + 0.4 * np.sin(x / 3) * np.cos(y / 4))[None, :, :, None]
    draw = np.random.default_rng(index).normal(0, noise, frame.images.shape)
    return shown(frame, index, lambda images: pattern + draw)


def changed(before: Frame, after: Frame, threshold: float) -> Change:
    return find_change(*(list(map(torch.from_numpy, frame.images)) for frame in (before, after)), threshold)


@pytest.mark.parametrize("flash", FLASHES)
@pytest.mark.parametrize("threshold", [3.0, 4.0, 6.0])
def test_a_change_of_the_whole_picture_is_seen(flash: str, threshold: float) -> None:
    """The spread of the differences is taken for noise; when everything changes, the change hid itself, and the frame
    was sent as "nothing changed"."""
    before, after = textured(0), textured(1)
    change = changed(before, shown(after, 1, FLASHES[flash]), threshold)
    assert change.share > 0.3
    still = changed(before, after, threshold)
    assert still.share < 0.05, "noise alone is still no change"


@pytest.mark.parametrize("gain", [0.9, 0.95, 1.05, 1.1])
def test_a_slow_change_of_the_light_is_no_noise(gain: float) -> None:
    """A dimmer that turns by a few percent a frame widened the measured noise as fast as it changed the picture: seven
    frames of a recording with a swinging gain were sent as "nothing changed"."""
    _, _, frame = begun()
    y, x = np.mgrid[:24, :32]
    lit = (0.5 + 0.35 * np.sin(x / 15) * np.cos(y / 18))[None, :, :, None]

    def exposed(index: int, gain: float) -> Frame:
        draw = np.random.default_rng(index).normal(0, 0.006, frame.images.shape)
        return shown(frame, index, lambda images: gain * lit + draw)

    change, still = (changed(exposed(0, 1.0), exposed(1, g), 6.0) for g in (gain, 1.0))
    assert change.share > 0.5
    assert still.share == 0


def test_an_alternating_flash_is_followed_both_ways() -> None:
    subject, state, frame = begun()
    bright, changed = FLASHES["half as bright again"], []
    for index in range(1, 7):
        now = shown(frame, index, bright if index % 2 else lambda images: images)
        step = subject.step(state, now)
        state = step.state
        assert_sound(state)
        changed.append(step.metrics["changed_tiles"] > 0 or "lamp" in step.metrics)
    assert all(changed)
    assert quality(subject, state, frame) > 10


@pytest.mark.parametrize("lr", [1e3, 1e20, 1e30])
def test_a_spike_of_the_learning_rate_is_refused_or_survived_never_sent_as_garbage(
    lr: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject, state, frame = begun()
    plain = _Fit.__init__

    def spiked(self: Any, *args: Any) -> None:
        plain(self, *args)
        self.code.lrs.mul_(lr)

    monkeypatch.setattr(_Fit, "__init__", spiked)
    now = shown(frame, 1, FLASHES["upside down"])
    if lr == 1e3:
        assert_sound(subject.step(state, now).state)
        return
    with pytest.raises((ShapeError, ComponentError), match="expected"):
        subject.step(state, now)
    stream = subject.assembly.recipe.stream.model_copy(update={"on_error": "repeat"})
    forgiving = copy.copy(subject)
    forgiving.assembly = replace(subject.assembly, recipe=subject.assembly.recipe.model_copy(update={"stream": stream}))
    with pytest.warns(UserWarning, match="repeats the one before"):
        step = forgiving.step(state, now)
    assert step.status == "empty"
    assert_sound(step.state)


def optimisers() -> list[RowOptimiser]:
    try:
        from gsstream_cpu_render.renderer import CpuAdam
    except ImportError:
        return [ReferenceAdam()]
    return [ReferenceAdam(), CpuAdam()]


@pytest.mark.parametrize("part", optimisers(), ids=lambda part: type(part).__name__)
@pytest.mark.parametrize("size", [1e19, 3e38, -1e25, np.nan, np.inf])
def test_a_gradient_whose_square_overflows_is_refused_and_kills_no_row(part: RowOptimiser, size: float) -> None:
    """It was finite, so it was taken; its square was infinite, and the row never moved again."""
    values = torch.zeros(5, 3)
    state = AdamState.start(values)
    gradient = torch.ones(5, 3)
    gradient[3, 1] = size
    with pytest.raises(ShapeError, match=r"gradient of x: expected"):
        part.step({"x": values}, {"x": gradient}, {"x": state}, {"x": 0.1})
    assert not values.any()
    part.step({"x": values}, {"x": torch.ones(5, 3)}, {"x": state}, {"x": 0.1})
    assert bool((values < -0.09).all())


@given(st.floats(-18, 17.9), st.integers(1, 40))
@some(40)
def test_a_constant_gradient_moves_by_the_rate_whatever_its_unit(power: float, steps: int) -> None:
    """Down to eps = 1e-15; below it steps shrink with the gradient instead of exploding."""
    assert 10.0**power < MAX_GRADIENT
    for part in optimisers():
        values = torch.zeros(2, 2)
        state = AdamState.start(values)
        for _ in range(steps):
            part.step({"x": values}, {"x": torch.full((2, 2), 10.0**power)}, {"x": state}, {"x": 0.1})
        share = 10.0**power / (10.0**power + 1e-15)
        assert float(values[0, 0]) == pytest.approx(-0.1 * steps * share, rel=1e-4)
