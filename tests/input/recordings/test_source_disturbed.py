"""disturbed:KEY=VALUE,...:URI does what its options say; bad images stop, repeat or drop as asked."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import reopen_recording
from gsstream.input.recordings.base import Wrapped
from gsstream.input.recordings.disturbed import DisturbedSource
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.options import DataOptions, Disturbances
from gsstream.input.recordings.sync import RecordingWarning
from gsstream.input.recordings.transformed import transformed

WORLD = "synthetic:frames=12&views=4&width=16&height=12&supersample=1&motion=3"
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "nothing": ("", {}, 0),
    "gain": ("gain=0.5", {"gain": 0.5}, 0),
    "noise": ("noise_sigma=9,noise_frames=3,seed=4", {"noise_sigma": 9, "noise_frames": 3}, 4),
    "light": ("gain_amplitude=0.4,gain_pattern=random,seed=2", {"gain_amplitude": 0.4, "gain_pattern": "random"}, 2),
    "losses": ("lost_share=0.5,lost_as=black,seed=1", {"lost_share": 0.5, "lost_as": "black"}, 1),
    "cameras": ("lost_cameras=NAME@3-6+NAME@8-9", {"lost_cameras": ("NAME@3-6", "NAME@8-9")}, 0),
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
    found = open_source(whole)
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
    fewer = transformed(open_source(f"disturbed:gain=0.9:{WORLD}"), split).points()
    assert fewer is None or len(fewer) <= len(plain.points())
    assert transformed(open_source(f"disturbed:gain=0.9:{WORLD}"), DataOptions(test_cameras=())).points() is not None


def test_it_nests_scales_and_reopens() -> None:
    uri = f"disturbed:gain=0.5:disturbed:gain=0.5:{WORLD}"
    once = open_source(f"disturbed:gain=0.25:{WORLD}").frame(3).images
    assert open_source(uri).frame(3).images == pytest.approx(once, abs=1e-7)
    assert open_source(uri, 0.5).info.train.width == 8
    again = reopen_recording(uri, {"scale": 1.0}, load_catalog())
    assert again.frame(3).images.tobytes() == open_source(uri).frame(3).images.tobytes()


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
        open_source(uri)


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """The demo; one training image and one test image of frames 3 and 5 are cut short, the latter in two frames."""
    folder = tmp_path / "demo"
    shutil.copytree(DEMO_FOLDER, folder)
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    train, test = (next(c for c in cameras if c["split"] == split) for split in ("train", "test"))
    for camera, frames in ((train, (3, 4)), (test, (5,))):
        for index in frames:
            path = folder / (camera["frames"] % index)
            path.write_bytes(path.read_bytes()[:200])
    return folder


def test_by_default_a_bad_image_stops_with_its_name(damaged) -> None:
    for options in ({}, {"leak": "points"}):
        source = transformed(open_source(str(damaged)), DataOptions(**options))
        assert source.frame(2).images.shape[0] > 1
        with pytest.raises(SourceError, match="000003"):
            source.frame(3)


@pytest.mark.parametrize("policy", ["repeat", "drop"])
def test_a_bad_image_is_repeated_or_its_frame_dropped(policy, damaged) -> None:
    whole, source = open_source("demo"), transformed(open_source(str(damaged)), DataOptions(bad_image=policy))
    for index in range(7):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            frame, test = source.frame(index), source.frame(index, "test")
        bad = index in (3, 4)
        expected = whole.frame(index).images.copy()
        if bad:
            expected[0] = whole.frame(2).images[0]
        assert np.array_equal(frame.images, expected)
        assert frame.epoch_scale == (0.0 if bad and policy == "drop" else 1.0)
        assert len(test.cameras) == len(test.images) == (0 if index == 5 else len(whole.info.test))
        words = " ".join(str(w.message) for w in told if issubclass(w.category, RecordingWarning))
        assert (f"frame {index}, camera" in words) == (bad or index == 5)


def test_frame_0_needs_every_image(damaged) -> None:
    name = json.loads((damaged / "cameras.json").read_text())["cameras"][0]["frames"] % 0
    (damaged / name).write_bytes(b"no picture")
    with pytest.raises(SourceError, match="000000"):
        transformed(open_source(str(damaged)), DataOptions(bad_image="repeat")).frame(0)


def test_the_end_of_a_recording_is_no_bad_image() -> None:
    class Ended(Wrapped):
        def stored_image(self, index: int, camera: str) -> Any:
            if index > 2:
                raise EndOfRecording("the recording ended after 3 frames")
            return super().stored_image(index, camera)

    source = transformed(Ended(open_source(WORLD)), DataOptions(bad_image="repeat"))
    assert source.frame(2).index == 2
    with pytest.raises(EndOfRecording):
        source.frame(3)
