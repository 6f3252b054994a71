"""disturbed:KEY=VALUE,...:URI does what its options say, exactly and repeatably, and nothing else."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gsstream_lab.disturbances import Disturbances, gain_at
from gsstream_lab.disturbed import DisturbedSource, open_disturbed
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.errors import SourceError
from gsstream.core.frame import Arrival
from gsstream.core.rng import Rng
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import reopen_recording
from gsstream.input.recordings.base import Source, SourceInfo, Wrapped
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.transformed import transformed
from gsstream.testing import SourceUnderTest, parametrize_with_checks

WORLD = "synthetic:frames=12&views=4&width=16&height=12&supersample=1&motion=3"
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "nothing": ("", {}, 0),
    "gain": ("gain=0.5", {"gain": 0.5}, 0),
    "noise": ("noise_sigma=9,noise_frames=3,seed=4", {"noise_sigma": 9, "noise_frames": 3}, 4),
    "light": ("gain_amplitude=0.4,gain_pattern=random,seed=2", {"gain_amplitude": 0.4, "gain_pattern": "random"}, 2),
    "losses": ("lost_share=0.5,lost_as=black,seed=1", {"lost_share": 0.5, "lost_as": "black"}, 1),
    "cameras": ("lost_cameras=NAME@3-6+NAME@8-9", {"lost_cameras": ("NAME@3-6", "NAME@8-9")}, 0),
    "drift": ("drift=NAME@-0.01", {"drift": ("NAME@-0.01",)}, 0),
    "clocks": ("time_offset=NAME@2", {"time_offset": ("NAME@2",)}, 0),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("uri", [WORLD, "demo"])
def test_the_text_is_the_options_bit_by_bit(case, uri) -> None:
    text, options, seed = CASES[case]
    plain = open_source(uri)
    name = plain.info.train.ids[2]
    options = {k: tuple(e.replace("NAME", name) for e in v) if isinstance(v, tuple) else v for k, v in options.items()}
    expected = DisturbedSource(plain, Disturbances(**options), seed, uri)
    whole = f"disturbed:{text.replace('NAME', name)}:{uri}"
    found = open_disturbed(whole)
    assert found.info.uri == whole
    assert found.info.train.ids == expected.info.train.ids
    for index in (0, 1, 4, 8):
        for split in ("train", "test"):
            assert found.frame(index, split).images.tobytes() == expected.frame(index, split).images.tobytes()
    points = found.points(), expected.points()
    assert (points[0] is None) == (points[1] is None)


def test_a_split_over_a_disturbed_recording_keeps_its_points_honest() -> None:
    """Held-out cameras take their points along through the wrapper as they do without it."""
    plain = open_source(WORLD)
    name = plain.info.train.ids[1]
    split = DataOptions(test_cameras=(name,))
    fewer = transformed(open_disturbed(f"disturbed:gain=0.9:{WORLD}"), split).points()
    assert fewer is None or len(fewer) <= len(plain.points())
    assert transformed(open_disturbed(f"disturbed:gain=0.9:{WORLD}"), DataOptions(test_cameras=())).points() is not None


def test_it_nests_scales_and_reopens() -> None:
    uri = f"disturbed:gain=0.5:disturbed:gain=0.5:{WORLD}"
    once = open_disturbed(f"disturbed:gain=0.25:{WORLD}").frame(3).images
    assert open_disturbed(uri).frame(3).images == pytest.approx(once, abs=1e-7)
    assert open_disturbed(uri, 0.5).info.train.width == 8
    again = reopen_recording(uri, {"scale": 1.0}, load_catalog())
    assert again.frame(3).images.tobytes() == open_disturbed(uri).frame(3).images.tobytes()


def disturbed(uri: str = WORLD, seed: int = 0, **options: Any):
    return DisturbedSource(open_source(uri), Disturbances(**options), seed, uri)


@pytest.mark.parametrize("uri", [WORLD, "demo"])
def test_a_change_that_touches_no_frame_leaves_every_bit(uri: str) -> None:
    """A loss far behind the end: the wrapper is there and must be invisible."""
    plain = open_source(uri)
    wrapped = disturbed(uri, lost_cameras=(f"{plain.info.train.ids[1]}@900-901",))
    assert wrapped is not plain
    for index in (0, 7):
        for split in ("train", "test"):
            theirs, ours = plain.frame(index, split), wrapped.frame(index, split)
            assert ours.cameras.ids == theirs.cameras.ids
            assert ours.images.tobytes() == theirs.images.tobytes()
            assert ours.timestamp == theirs.timestamp
    cloud = wrapped.points()
    assert cloud is not None
    assert cloud.xyz.tobytes() == plain.points().xyz.tobytes()


@given(st.lists(st.integers(-3, 3), min_size=5, max_size=5))
@settings(max_examples=20, deadline=None)
def test_clocks_are_shifted_and_no_frame_is_shown_twice(offsets: list[int]) -> None:
    plain = open_source(WORLD)
    ids = (*plain.info.train.ids, *plain.info.test.ids)
    source = disturbed(time_offset=tuple(f"{i}@{o}" for i, o in zip(ids, offsets, strict=True)))
    start = max(0, -min(offsets))
    assert source.info.num_frames == 12 - max(0, -min(offsets)) - max(0, max(offsets))
    for index in (0, source.info.num_frames - 1):
        frame = source.frame(index)
        assert frame.index == index
        for row, offset in enumerate(offsets[:-1]):
            np.testing.assert_array_equal(frame.images[row], plain.frame(start + index + offset).images[row])
    with pytest.raises(SourceError, match="has no frame"):
        source.frame(source.info.num_frames)


@pytest.mark.parametrize("offsets", [(), ("cam01@2", "cam02@-1")])
def test_it_goes_there_and_back_as_often_as_asked_and_shows_each_end_once(offsets: tuple[str, ...]) -> None:
    once, thrice = disturbed(time_offset=offsets), disturbed(time_offset=offsets, ways=3)
    there = [once.frame(t).images for t in range(once.info.num_frames or 0)]
    film = [*there, *there[-2::-1], *there[1:]]
    assert thrice.info.num_frames == len(film)
    for index, images in enumerate(film):
        assert np.array_equal(thrice.frame(index).images, images), index
        assert thrice.frame(index).index == index
    with pytest.raises(SourceError, match="has no frame"):
        thrice.frame(len(film))


def test_where_a_film_that_is_still_written_turns_nobody_knows() -> None:
    class Unended(Wrapped):
        @property
        def info(self) -> SourceInfo:
            return replace(self._source.info, num_frames=None)

    live = Unended(open_source(WORLD))
    with pytest.raises(SourceError, match=r"ways: .* nobody knows where to turn"):
        DisturbedSource(live, Disturbances(ways=2), 0, live.info.uri)


@given(
    st.sampled_from(["sine", "random"]), st.floats(0.2, 2), st.floats(0, 0.9), st.integers(0, 400), st.integers(0, 9)
)
@settings(max_examples=60, deadline=None)
def test_gain_stays_in_its_range(pattern: Any, gain: float, amplitude: float, index: int, seed: int) -> None:
    options = Disturbances(gain=gain, gain_amplitude=amplitude, gain_pattern=pattern)
    value = gain_at(options, index, Rng(seed))
    assert gain * (1 - amplitude) - 1e-9 <= value <= gain * (1 + amplitude) + 1e-9
    if pattern == "sine" and index % 60 == 0:
        assert value == pytest.approx(gain)
    if pattern == "sine" and index % 60 == 15:
        assert value == pytest.approx(gain * (1 + amplitude))


def test_gain_touches_test_cameras_and_saturates() -> None:
    plain, source = open_source(WORLD), disturbed(gain=3.0)
    for split in ("train", "test"):
        truth = np.minimum(plain.frame(4, split).images * np.float32(3), 1)
        np.testing.assert_array_equal(source.frame(4, split).images, truth)
        assert truth.max() == 1


def test_one_camera_drifts_in_exposure_or_colour_and_no_other() -> None:
    plain = open_source(WORLD)
    one, test = plain.info.train.ids[1], plain.info.test.ids[0]
    for text, shares, split, row in (
        (f"{one}@-0.02", [-0.02] * 3, "train", 1),
        (f"{one}@0.3", [0.3] * 3, "train", 1),
        (f"{test}@0.02/0/-0.02", [0.02, 0, -0.02], "test", 0),
    ):
        source = disturbed(drift=(text,))
        for index in (0, 1, 7):
            before, after = plain.frame(index, split).images, source.frame(index, split).images.copy()
            wanted = np.clip(before[row] * (1 + index * np.float32(shares)), 0, 1)
            np.testing.assert_allclose(after[row], wanted, atol=1e-6)
            after[row] = before[row]
            assert np.array_equal(after, before)
        assert not source.stores_bytes


def test_noise_has_its_sigma_hits_training_images_of_the_first_frames_and_follows_the_seed() -> None:
    plain = open_source(WORLD.replace("width=16&height=12", "width=96&height=72"))
    source = DisturbedSource(plain, Disturbances(noise_sigma=10, noise_frames=2), 5, WORLD)
    for index in (0, 1):
        before, after = plain.frame(index).images, source.frame(index).images
        inside = (before > 0.2) & (before < 0.8)
        assert (after - before)[inside].std() * 255 == pytest.approx(10, rel=0.02)
        assert abs((after - before)[inside].mean()) * 255 < 0.2
        assert 0 <= after.min() <= after.max() <= 1
    assert source.frame(2).images.tobytes() == plain.frame(2).images.tobytes()
    assert source.frame(0, "test").images.tobytes() == plain.frame(0, "test").images.tobytes()
    again, other = (
        DisturbedSource(plain, Disturbances(noise_sigma=10), seed, WORLD).frame(0).images for seed in (5, 6)
    )
    assert again.tobytes() == source.frame(0).images.tobytes() != other.tobytes()


def test_lost_images_hold_the_last_one_or_are_black() -> None:
    plain = open_source(WORLD)
    name = plain.info.train.ids[2]
    hold = disturbed(lost_cameras=(f"{name}@3-6", f"{name}@8-9"))
    black = disturbed(lost_cameras=(f"{name}@3-6",), lost_as="black")
    for index in range(10):
        shown = 2 if 3 <= index < 6 else 7 if index == 8 else index
        np.testing.assert_array_equal(hold.frame(index).images[2], plain.frame(shown).images[2])
        np.testing.assert_array_equal(hold.frame(index).images[[0, 1, 3]], plain.frame(index).images[[0, 1, 3]])
        assert (black.frame(index).images[2].max() == 0) == (3 <= index < 6)


def test_random_losses_have_their_share_and_spare_frame_0_and_the_test_camera() -> None:
    source = disturbed(WORLD.replace("frames=12", "frames=200"), lost_share=0.3, lost_as="black")
    lost = np.array([source.frame(i).images.max(axis=(1, 2, 3)) == 0 for i in range(200)])
    assert not lost[0].any()
    assert abs(lost[1:].mean() - 0.3) < 4 * math.sqrt(0.21 / lost[1:].size)
    assert source.frame(5, "test").images.max() > 0


def test_a_test_camera_is_not_lost() -> None:
    test = open_source(WORLD).info.test.ids[0]
    with pytest.raises(SourceError, match="lost_cameras: no camera"):
        disturbed(lost_cameras=(f"{test}@1-5",))


FAULTS = {
    "disturbed:demo": "expected disturbed:KEY=VALUE,...:URI",
    "disturbed:fog=1:demo": "keys: seed, gain",
    "disturbed:gian=1:demo": "did you mean 'gain'",
    "disturbed:gain:demo": "expected KEY=VALUE",
    "disturbed:gain=9:demo": "less than or equal to 4.*factor on all images",
    "disturbed:gain=x:demo": "option 'gain' = 'x'",
    "disturbed:gain=1,gain=2:demo": "given twice",
    "disturbed:seed=-1:demo": "expected a whole number",
    "disturbed:lost_cameras=cam03:demo": "expected ID@A-B",
    "disturbed:lost_cameras=nobody@1-2:demo": "lost_cameras: no camera 'nobody'",
    "disturbed:lost_cameras=cam03@5-5:demo": "expected ID@A-B with 1 <= A < B",
    "disturbed:lost_cameras=cam03@0-5:demo": "frame 0 needs every training camera",
    "disturbed:ways=0:demo": "greater than or equal to 1.*there, back",
    "disturbed:drift=cam03:demo": "drift: expected ID@SHARE",
    "disturbed:drift=cam03@0/0:demo": "ID@RED/GREEN/BLUE.*got 'cam03@0/0'",
    "disturbed:drift=cam03@nan:demo": "between -1 and 1",
    "disturbed:drift=cam9@0.1:demo": "drift: no camera 'cam9'",
    "disturbed:time_offset=cam03:demo": "expected ID@FRAMES",
    "disturbed:time_offset=cam03@0.5:demo": "whole frames",
    "disturbed:time_offset=cam9@1:demo": "time_offset: no camera 'cam9'",
    "disturbed:time_offset=cam03@1+cam03@2:demo": "given twice",
    "disturbed:time_offset=cam03@12:demo": "leave no common frame of the 12",
    "disturbed:gain=1:nowhere": "no such folder",
    "disturbed:gain=1:": "no such folder",
}


@pytest.mark.parametrize("uri", FAULTS)
def test_faulty_ones_are_explained(uri) -> None:
    with pytest.raises(SourceError, match=FAULTS[uri]):
        open_disturbed(uri)


TINY = "synthetic:frames=6&views=3&width=32&height=24&supersample=1"


@parametrize_with_checks(
    [
        SourceUnderTest(open_disturbed, f"disturbed:{text}:{TINY}")
        for text in (
            "gain=0.9,noise_sigma=5",
            "lost_share=0.5,lost_as=black",
            "time_offset=cam01@2",
            "ways=3",
            "drift=cam01@-0.1",
        )
    ]
)
def test_it_is_a_source_like_any_other(check) -> None:
    check()


def test_frames_of_a_growing_recording_are_worth_what_they_are_without_it(tmp_path: Path) -> None:
    folder = tmp_path / "live"
    shutil.copytree(DEMO_FOLDER, folder)
    for image in folder.glob("cam*/*.jpg"):
        os.utime(image, (0, 1000 + 10 * int(image.stem)))
    live = open_source(f"watch:{folder}?missing=hold&grace=0", 0.25)
    late, absent, test = live.info.train.ids[2], live.info.train.ids[1], live.info.test.ids[0]
    for camera in (absent, test):
        (folder / camera / "000002.jpg").unlink()

    def under(**options: Any) -> Source:
        return DisturbedSource(live, Disturbances(**options), 0, live.info.uri)

    gained, ahead = under(gain=0.5), under(time_offset=(f"{late}@1",))
    assert ahead.frame(0).arrival == Arrival(1010.0), "it waits for the next image of that camera"
    assert gained.frame(1).arrival == Arrival(1010.0)
    assert [len(gained.frame(t, "test").cameras) for t in range(4)] == [1, 1, 0, 1]
    arrival = gained.frame(2).arrival
    assert arrival is not None
    assert arrival.absent == (absent,)
    assert np.array_equal(gained.frame(2).images, np.float32(0.5) * live.frame(2).images)
    behind = open_source(f"watch:{DEMO_FOLDER}?behind=drop&queue=2", 0.25)
    dropped = DisturbedSource(behind, Disturbances(gain=0.5), 0, behind.info.uri)
    assert [dropped.frame(t).epoch_scale for t in (0, 9, 10)] == [0, 0, 0]
    assert [dropped.epoch_scale(t) for t in (0, 9, 11)] == [1, 0, 1]


def test_without_the_lab_one_sentence_says_what_brings_it() -> None:
    with pytest.raises(SourceError, match=r"the source 'disturbed' comes with another distribution: .*install"):
        open_source("disturbed:gain=1:demo")
