"""The memory of still pixels: what it is the mean of, when it forgets, and that a resumed run has the same."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsstream.core.frame import Frame
from gsstream.engine.still.memory import LEAST_COUNT, MOST, REACH, STEPS, StillMemory
from gsstream.packet import StreamWriter
from gsstream.recipe.model import Stream
from gsstream.source.open import open_source
from gsstream.testing.stepping import MethodUnderTest

SIZE = (48, 64)


def pictures(number: int, sigma: float = 0.006, seed: int = 0) -> np.ndarray:
    """[T, 1, H, W, 3] noisy pictures of a picture that stands still."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.2, 0.8, (*SIZE, 3))
    return (truth + sigma * rng.standard_normal((number, 1, *SIZE, 3))).clip(0, 1).astype(np.float32)


def after(images: np.ndarray) -> StillMemory:
    memory = StillMemory.start(images[0])
    for image in images[1:]:
        memory = memory.after(image)
    return memory


@pytest.mark.parametrize("number", [2, 5, 20])
def test_it_is_the_mean_of_what_stood_still(number: int) -> None:
    images = pictures(number)
    memory = after(images)
    assert (memory.count == number).all()
    # Each of the means on the way was rounded to half a step.
    assert np.abs(memory.values(0) - images[:, 0].mean(0, dtype=np.float64)).max() < number / STEPS


def test_the_noise_is_measured_and_the_mean_has_less_of_it() -> None:
    images = pictures(16)
    memory = after(images)
    assert memory.sigma[0] == pytest.approx(0.006, rel=0.1)
    truth = pictures(400, seed=0)[:, 0].mean(0)
    off = memory.values(0) - truth
    assert off.std() == pytest.approx(0.006 / 4, rel=0.15)


def test_old_pictures_fade_and_the_count_is_bounded() -> None:
    images = pictures(MOST + 200)
    drift = np.linspace(0, 0.02, len(images), dtype=np.float32)  # far below the noise from frame to frame
    memory = after((images + drift[:, None, None, None, None]).clip(0, 1))
    assert int(memory.count.max()) == MOST
    lag = float((images[:, 0].mean(0) + drift[-1] - memory.values(0)).mean())
    assert 0 < lag < 1.5 * MOST * float(drift[1])


def test_what_changes_is_forgotten_around_and_nothing_else() -> None:
    images = pictures(8)
    images[-1, 0, 20:28, 20:28] += 0.2
    memory = after(images)
    reach = 4 * REACH
    assert (memory.count[0, 20:28, 20:28] == 1).all()
    assert np.abs(memory.values(0)[20:28, 20:28] - images[-1, 0, 20:28, 20:28]).max() < 1 / STEPS
    far = memory.count[0, :, 28 + reach + 4 :]
    assert far.size
    assert (far == 8).all()
    targets = memory.targets(images[-1])
    young = memory.count < LEAST_COUNT
    assert young.any()
    assert (targets[young] == images[-1][young]).all()
    assert np.array_equal(targets[0][~young[0]], memory.values(0)[~young[0]])


def test_seven_bytes_per_pixel_and_camera() -> None:
    memory = after(pictures(3))
    assert memory.mean.nbytes + memory.count.nbytes == 7 * SIZE[0] * SIZE[1]


def test_a_picture_outside_by_rounding_is_no_wrap_around() -> None:
    images = np.full((2, 1, *SIZE, 3), 1.00005, np.float32)
    images[:, :, :24] = -0.00005
    values = after(images).values(0)
    assert np.abs(values[:24]).max() == 0
    assert np.abs(values[24:] - 1).max() == 0


def test_healing_needs_the_memory() -> None:
    with pytest.raises(ValueError, match="remember: true"):
        Stream(heal=0.1)


# A whole stream: two bodies move in small pictures, and after a frame 0 of eight iterations much else is unfinished.

URI = "synthetic:frames=8&views=4&width=112&height=84&supersample=1&noise=0.004&shadows=false"


def method(**stream: Any) -> MethodUnderTest:
    made = MethodUnderTest("dense")
    recipe = made.parts.recipe
    changed = recipe.stream.model_copy(update={"change_threshold": 6.0, "change_votes": 0.75, "epochs": 4, **stream})
    first = recipe.first_frame.model_copy(update={"max_points": 3000})
    recipe = recipe.model_copy(update={"stream": changed, "first_frame": first})
    made.parts = replace(made.parts, recipe=recipe)
    return made


def encoded(made: MethodUnderTest, frames: list[Frame]) -> list[Any]:
    encoder = made.encoder(URI)
    return [encoder.encode(frame) for frame in frames]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    source = open_source(URI)
    return [source.frame(index) for index in range(8)]


@pytest.fixture(scope="module")
def healed(frames: list[Frame]) -> list[Any]:
    return encoded(method(remember=True, heal=0.2), frames)


def test_healing_brings_the_scene_nearer_to_what_stood_still(frames: list[Frame], healed: list[Any]) -> None:
    left = encoded(method(remember=True), frames)
    memory = healed[-1].state.memory
    still = memory.count >= LEAST_COUNT
    assert 0.1 < still.mean() < 1

    def wrong(steps: list[Any]) -> float:
        made, state = method(), steps[-1].state
        total = 0.0
        for view in range(4):
            image = made.parts.renderer.render(
                state.gaussians, state.previous.cameras, view, made.parts.recipe.background
            ).image.detach().numpy()  # fmt: skip
            total += float(((image - memory.values(view)) ** 2)[still[view]].sum())
        return total

    assert wrong(healed) < 0.8 * wrong(left)


def test_a_resumed_run_remembers_the_same(frames: list[Frame], healed: list[Any], tmp_path: Any) -> None:
    made = method(remember=True, heal=0.2)
    path = tmp_path / "stream.gss"
    with StreamWriter.open(path) as writer:
        for step in healed[:6]:
            writer.append(step.packet)
    encoder = made.encoder(URI)
    assert encoder.resume(path, open_source(URI).frame) == 5
    for name in ("mean", "count", "sigma"):
        assert np.array_equal(getattr(encoder.state.memory, name), getattr(healed[5].state.memory, name)), name
    for frame, step in zip(frames[6:], healed[6:], strict=True):
        assert encoder.encode(frame).packet.data == step.packet.data


def test_without_it_nothing_is_remembered(frames: list[Frame]) -> None:
    assert all(step.state.memory is None for step in encoded(method(), frames[:3]))
