"""What a choice comes to in short frames 0: who judges, how often it is fitted, and what is compared."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import final

import numpy as np
import pytest
from auto_parts import asking
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.auto import Choice
from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame, PointCloud
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.auto.rules import settle
from gsstream.engine.auto.short_fits import HALVED, HOPELESS, FirstFrameTrials, Trial, colour_matched, left_out
from gsstream.packet import StreamMeta
from gsstream.structure.base import Anchors
from gsstream.structure.flat import Flat
from gsstream.testing.cases import rig
from gsstream.testing.common.auto import extreme_scenes


@given(count=st.integers(0, 500), share=st.floats(0.001, 0.999), folds=st.integers(1, 8))
def test_who_is_left_out(count: int, share: float, folds: int) -> None:
    """Folds are disjoint, as many as there are cameras for, and each is evenly spread."""
    made = left_out(count, share, folds)
    if count < 4:
        assert made == []
        return
    number = min(max(1, round(share * count)), count // 2)
    assert len(made) == min(folds, count // number)
    everyone = [camera for judges in made for camera in judges]
    assert len(set(everyone)) == len(everyone) == number * len(made)
    for judges in made:
        assert judges == sorted(judges)
        assert judges[0] >= 0
        assert judges[-1] < count
        gaps = np.diff([*judges, judges[0] + count])
        assert gaps.max() - gaps.min() <= 1


@given(count=st.integers(4, 500), share=st.floats(0.001, 0.999), folds=st.integers(1, 8))
def test_one_fold_leaves_out_the_middle_of_equal_shares(count: int, share: float, folds: int) -> None:
    (judges,) = left_out(count, share, 1)
    assert judges == [int((i + 0.5) * count / len(judges)) for i in range(len(judges))]
    assert left_out(count, share, folds)[0] == judges


@given(
    folds=st.lists(st.floats(10, 40), min_size=1, max_size=5), fewer=st.integers(1, 5), size=st.integers(1, 10**7)
)
def test_a_gain_is_over_the_folds_that_both_have(folds: list[float], fewer: int, size: int) -> None:
    whole, part = Trial(tuple(folds), 1, size), Trial(tuple(value + 1 for value in folds[:fewer]), 1, 2 * size)
    assert part.gain(whole) == pytest.approx(1 - HALVED)
    assert whole.gain(part) == pytest.approx(HALVED - 1)
    assert part.beats(whole) == (fewer >= len(folds))
    assert not whole.beats(part)


@final
class Growing(Flat):  # type: ignore[misc]  # a test may inherit
    """Starts from as many of the points as ``wide`` says, at most three (ours)."""

    class Config(Flat.Config):
        wide: int = 0

    auto_rules = MappingProxyType({"wide": lambda facts, config: Choice(1, "one", (1, 2, 3, 4))})

    def seed(self, points: PointCloud, cameras: Cameras) -> Anchors:
        return super().seed(PointCloud(points.xyz[: self.config.wide], points.rgb[: self.config.wide], "few"), cameras)


def of(wide: int) -> Assembly:
    parts = settle(asking(Growing, wide="auto"), lambda: extreme_scenes()[0], {})
    return replace(parts, structure=Growing(Growing.Config(wide=wide)))


class Counted(FirstFrameTrials):
    """Every fit is a number that is known: (Gaussians, fold) -> PSNR. Remembers which were asked for."""

    def __init__(self, values: dict[int, tuple[float, ...]]) -> None:
        draw = np.random.default_rng(0)
        xyz = draw.normal(size=(3, 3)).astype(np.float32)
        cameras = rig(8)
        images = np.zeros((8, cameras.height, cameras.width, 3), np.float32)
        meta: StreamMeta = None  # type: ignore[assignment]  # no packet is made
        folds = left_out(8, 0.25, len(values[1]))
        super().__init__(PointCloud(xyz, np.abs(xyz), "three"), Frame(0, 0.0, images, cameras), meta, 0, folds)
        self.values, self.made = values, list[tuple[int, int]]()

    def _fit(self, parts: Assembly, fold: int) -> Trial:
        wide = min(parts.structure.config.wide, 3)
        self.made.append((wide, fold))
        return Trial((self.values[wide][fold],), wide, 1000)


def test_the_same_start_is_one_trial_with_all_its_folds() -> None:
    trials = Counted({1: (20.0, 21.0, 22.0), 3: (20.0, 21.0, 23.0)})
    first = trials(of(1), None)
    assert first == Trial((20.0, 21.0, 22.0), 1, 1000)
    three = trials(of(3), first)
    assert trials(of(4), first) is three
    assert trials(of(1), three) is first
    assert trials.made == [(1, 0), (1, 1), (1, 2), (3, 0), (3, 1), (3, 2)]


@pytest.mark.parametrize(("behind", "fits"), [(0.9 * HOPELESS, 2), (1.1 * HOPELESS, 1)])
def test_what_is_far_behind_gets_no_second_fold(behind: float, fits: int) -> None:
    trials = Counted({1: (20.0, 20.0), 2: (20.0 - behind, 30.0)})
    best = trials(of(1), None)
    assert len(trials(of(2), best).folds) == fits
    assert trials(of(2), best).beats(best) == (fits == 2)
    fresh = Counted({1: (20.0, 20.0), 2: (20.0 - behind, 30.0)})
    assert len(fresh(of(2), None).folds) == 2


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_a_camera_of_its_own_colours_is_matched(seed: int) -> None:
    draw = np.random.default_rng(seed)
    image = draw.uniform(0.2, 0.8, (9, 7, 3)).astype(np.float32)
    matrix = np.eye(3) * 0.7 + draw.uniform(-0.05, 0.05, (3, 3))
    seen = (image @ matrix + 0.1).astype(np.float32)
    np.testing.assert_allclose(colour_matched(image, seen), seen, atol=2e-6)
    noisy = (seen + draw.normal(0, 0.05, seen.shape)).astype(np.float32)
    best = np.square(colour_matched(image, noisy) - noisy).mean()
    for other in (image, image * 1.01, (image @ matrix + 0.1)):
        assert best <= np.square(other - noisy).mean() + 1e-9


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_an_image_of_one_colour_is_matched_to_the_mean(value: float) -> None:
    image = np.full((4, 5, 3), value, np.float32)
    seen = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)
    matched = colour_matched(image, seen)
    np.testing.assert_allclose(matched, np.broadcast_to(seen.reshape(-1, 3).mean(0), seen.shape), atol=1e-5)
