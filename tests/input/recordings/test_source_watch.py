"""A growing folder, read frame by frame in this process."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.frame import Arrival
from gsstream.input.recordings import watch
from gsstream.input.recordings.base import Moment, Source
from gsstream.input.recordings.images import read_stored
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.input.recordings.transformed import transformed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The demo recording, finished, in a place where it can be spoiled; the test camera is cam03 or so."""
    shutil.copytree(DEMO_FOLDER, tmp_path / "live")
    return tmp_path / "live"


def through(live: Source) -> Source:
    """The same under options of a run that change nothing of it."""
    return transformed(live, DataOptions(bad_image="repeat"))


@pytest.fixture
def test_camera() -> str:
    return open_source("demo").info.test.ids[0]


def test_it_reads_what_the_folder_reader_reads(folder: Path) -> None:
    live, finished = open_source(f"watch:{folder}", 0.5), open_source(str(folder), 0.5)
    assert live.info.uri == finished.info.uri
    for split in ("train", "test"):
        assert np.array_equal(live.frame(3, split).images, finished.frame(3, split).images)
    with pytest.raises(EndOfRecording, match="ended after 12 frames"):
        live.frame(12)


def test_an_absent_test_camera_is_not_measured(folder: Path, test_camera: str) -> None:
    (folder / test_camera / "000001.jpg").unlink()
    live = open_source(f"watch:{folder}?missing=hold&grace=0", 0.25)
    assert [len(live.frame(t, "test").cameras) for t in range(3)] == [1, 0, 1]
    assert live.frame(1).epoch_scale == 1
    split = through(live)
    assert [len(split.frame(t, "test").cameras) for t in range(3)] == [1, 0, 1]
    assert np.array_equal(split.frame(1).images, live.frame(1).images)


def test_transforms_keep_what_a_dropped_frame_is_worth(folder: Path) -> None:
    live = open_source(f"watch:{folder}?behind=drop&queue=2", 0.25)
    assert [through(live).frame(t).epoch_scale for t in (0, 9, 10)] == [0, 0, 0]
    assert live.frame(11).epoch_scale == 1


def test_a_frame_came_in_with_its_last_image_of_either_split(folder: Path, test_camera: str) -> None:
    for image in folder.glob("cam*/*.jpg"):
        os.utime(image, (0, 1000 + 10 * int(image.stem)))
    live = open_source(f"watch:{folder}", 0.25)
    late = live.info.train.ids[2]
    os.utime(folder / late / "000001.jpg", (0, 1012.5))
    split = through(live)
    came = [source.frame(1, split).arrival for source in (live, split) for split in ("train", "test")]
    assert came == [Arrival(1012.5)] * 4
    os.utime(folder / test_camera / "000001.jpg", (0, 1013.5))
    assert [source.frame(1).arrival for source in (live, split)] == [Arrival(1013.5)] * 2
    assert open_source(str(folder), 0.25).frame(1).arrival is None


def test_a_frame_says_which_training_cameras_are_absent(folder: Path, test_camera: str) -> None:
    live = open_source(f"watch:{folder}?missing=hold&grace=0", 0.25)
    name = live.info.train.ids[1]
    for camera in (name, test_camera):
        (folder / camera / "000001.jpg").unlink()
    for source in (live, through(live)):
        arrivals = [source.frame(t).arrival for t in range(3)]
        assert [arrival and arrival.absent for arrival in arrivals] == [(), (name,), ()]


def test_a_frame_that_is_skipped_is_not_even_read(folder: Path, test_camera: str) -> None:
    live = open_source(f"watch:{folder}?behind=drop&queue=2", 0.25)
    first = live.frame(0).images
    for camera in (live.info.train.ids[0], test_camera):
        (folder / camera / "000005.jpg").write_bytes(b"no picture")
    for source in (live, through(live)):
        skipped = source.frame(5)
        assert (skipped.epoch_scale, skipped.images.tobytes()) == (0, first.tobytes()), "the last pictures stand in"
        assert skipped.arrival is not None
        assert skipped.arrival.absent == (), "no camera is missing: the run is behind"
        assert [len(source.frame(t, "test").cameras) for t in (0, 5, 11)] == [1, 0, 1], "nor is it measured"
    assert live.frame(11).epoch_scale == 1
    assert not np.array_equal(live.frame(11).images, first)


@pytest.mark.parametrize(("policy", "worth"), [("block", [1, 1, 1]), ("drop", [1, 0, 1]), ("hurry", [1, 0.2, 1])])
def test_a_frame_that_was_read_ahead_is_checked_again_when_its_turn_comes(
    folder: Path, tmp_path: Path, policy: str, worth: list[float]
) -> None:
    later = tmp_path / "later"
    for camera in folder.glob("cam*/"):
        (later / camera.name).mkdir(parents=True)
        for t in range(2, 12):
            (camera / f"{t:06d}.jpg").rename(later / camera.name / f"{t:06d}.jpg")
    live = open_source(f"watch:{folder}?behind={policy}&queue=2", 0.25)
    split = through(live)
    assert [split.frame(t).epoch_scale for t in (0, 1)] == [1, 1], "nothing waits yet"
    assert live.epoch_scale(1) == 1
    for image in later.glob("*/*.jpg"):
        image.rename(folder / image.parent.name / image.name)
    # Ten frames wait behind frame 1; frame 0 is always made in full.
    assert [live.epoch_scale(0), split.epoch_scale(1), split.epoch_scale(11)] == worth


def test_an_image_that_comes_during_a_look_is_not_given_up(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its camera has gone on by the end of that look, in which the image was not there yet."""
    live = open_source(f"watch:{folder}?missing=hold&grace=0", 0.25)
    late = [folder / live.info.train.ids[1] / f"00000{t}.jpg" for t in (1, 2)]
    for path in late:
        path.rename(path.with_suffix(".part"))

    def slow(path: Path, *size: Any) -> np.ndarray:
        if path.stem == "000001":
            for one in late:
                if not one.exists():
                    one.with_suffix(".part").rename(one)
        return read_stored(path, *size)

    monkeypatch.setattr(watch, "read_stored", slow)
    arrival = live.frame(1).arrival
    assert arrival is not None
    assert arrival.absent == ()


def test_a_file_written_again_changes_no_frame_that_was_decided(folder: Path) -> None:
    live = open_source(f"watch:{folder}?missing=hold&grace=0", 0.25)
    name = live.info.train.ids[0]
    image = folder / name / "000001.jpg"
    image.rename(folder / "later.jpg")
    held = live.frame(1).images
    (folder / "later.jpg").rename(image)
    assert np.array_equal(live.frame(1).images, held), "the same frame gives the same bits"
    assert np.array_equal(live.frame(1).images[0], live.frame(0).images[0])


def test_interrupting_wakes_a_waiting_prefetcher(folder: Path) -> None:
    data = json.loads((folder / "cameras.json").read_text())
    del data["frames"]
    (folder / "cameras.json").write_text(json.dumps(data))
    live = open_source(f"watch:{folder}", 0.25)
    threading.Timer(0.5, live.interrupt).start()
    began = time.monotonic()
    with Prefetcher(live, range(11, 1000)) as frames:
        assert [pair[0].index for pair in frames] == [11]
    assert time.monotonic() - began < 20, "not the time-out of 30 s"
    assert live.info.num_frames == 12


def test_frame_0_needs_every_camera(folder: Path) -> None:
    shutil.rmtree(folder / "cam02")
    with pytest.raises(SourceError, match=r"frame 0 needs every camera \(no whole image of cam02\); start the capture"):
        open_source(f"watch:{folder}?timeout=0.2", 0.25).frame(0)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("watch:", "expected watch:DIR"),
        ("watch:nowhere", "no such folder"),
        ("watch:{}?policy=drop", "unknown option 'policy'"),
        ("watch:{}?behind=skip", "option 'behind' = 'skip'.*'block', 'drop' or 'hurry'"),
        ("watch:{}?queue", "expected key=value"),
    ],
)
def test_wrong_options_are_named(uri: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_source(uri.format(DEMO_FOLDER))


@pytest.mark.parametrize("skew", [-3600.0, -5.0, 0.0, 5.0])
def test_a_writer_with_another_clock_has_its_grace(folder: Path, skew: float) -> None:
    """A camera that is late by less than the grace is waited for, whatever time the writer's machine believes it is."""
    live = open_source(f"watch:{folder}?missing=hold&grace=8&settle=0", 0.25)
    name = live.info.train.ids[0]
    for path in [*folder.glob("*/00000[1-9].jpg"), *folder.glob("*/00001*.jpg")]:
        index = int(path.stem)
        if index > 1:
            path.unlink()
        else:
            os.utime(path, (time.time() + skew, time.time() + skew))
    late = folder / name / "000001.jpg"
    late.rename(folder / "late.jpg")
    threading.Timer(0.7, lambda: (folder / "late.jpg").rename(late)).start()
    frame = live.frame(1)
    assert np.array_equal(frame.images, open_source("demo", 0.25).frame(1).images), "nothing was held"


def test_grace_is_counted_by_the_files_when_the_run_lags_behind(folder: Path) -> None:
    """The writer has gone on for longer than the grace: nobody waits for what will not come."""
    live = open_source(f"watch:{folder}?missing=hold&grace=100", 0.25)
    (folder / live.info.train.ids[0] / "000001.jpg").unlink()
    (folder / live.info.train.ids[0] / "000002.jpg").unlink()
    for path in folder.glob("*/*.jpg"):
        os.utime(path, (1e9 + 200 * int(path.stem),) * 2)
    began = time.monotonic()
    frame = live.frame(1)
    assert time.monotonic() - began < 50
    assert np.array_equal(frame.images[0], live.frame(0).images[0])


def undeclared(folder: Path) -> Path:
    """The folder as one whose calibration does not say how many frames there will be."""
    data = json.loads((folder / "cameras.json").read_text())
    del data["frames"]
    (folder / "cameras.json").write_text(json.dumps(data))
    return folder


def a_picture_comes_late(folder: Path, camera: str) -> list[Path]:
    return [folder / camera / "000003.jpg", *folder.glob("cam*/00000[6-9].jpg")]


def more_wait_than_may(folder: Path, camera: str) -> list[Path]:
    return list(folder.glob("cam*/00001*.jpg"))


def numbers_are_left_out(folder: Path, camera: str) -> list[Path]:
    for path in folder.glob("cam*/00000[23].jpg"):
        path.unlink()
    return list(folder.glob("cam*/00000[89].jpg"))


@pytest.mark.parametrize("case", [a_picture_comes_late, more_wait_than_may, numbers_are_left_out])
@pytest.mark.filterwarnings("ignore:.*no camera has a frame between the numbers 1 and 4")
def test_a_run_that_goes_on_sees_what_it_saw(folder: Path, case: Callable[[Path, str], list[Path]]) -> None:
    """Whatever came since, and however many frames wait by now; ``case`` says which pictures come later."""
    query = f"watch:{undeclared(folder)}?missing=hold&grace=0&behind=drop&queue=3&ready=rename"
    later = case(folder, open_source(query).info.train.ids[0])
    for path in later:
        path.rename(path.with_suffix(".later"))
    first = open_source(query, 0.25)
    before = [first.stored_frame(t) for t in range(5)]
    past = {frame.index: Moment(frame.epoch_scale, frame.arrival) for frame in before}
    for path in later:
        path.with_suffix(".later").rename(path)
    again = open_source(query, 0.25)
    again.go_on_at(5, past)
    for was in before:
        now = again.stored_frame(was.index)
        assert np.array_equal(now.images, was.images), f"frame {was.index}"
        assert (now.epoch_scale, now.arrival.absent) == (was.epoch_scale, was.arrival.absent)
    numbers = sorted(int(path.stem) for path in folder.glob(f"{first.info.train.ids[0]}/*.jpg"))
    assert again.waiting(5) == len(numbers) - 6


def test_two_who_count_what_waits_at_once_do_not_add_up(folder: Path) -> None:
    """A frame is planned ahead on one thread while the frame in turn is asked for on another."""
    undeclared(folder)
    for _ in range(20):
        live = open_source(f"watch:{folder}")
        with ThreadPoolExecutor(8) as pool:
            assert set(pool.map(live.waiting, [0] * 64)) == {11}
