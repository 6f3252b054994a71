"""Images that cannot be read stop a run, are repeated, or their frame is dropped, as the options say."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.input.recordings.base import Wrapped
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.sync import RecordingWarning
from gsstream.input.recordings.transformed import transformed

WORLD = "synthetic:frames=12&views=4&width=16&height=12&supersample=1&motion=3"


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
