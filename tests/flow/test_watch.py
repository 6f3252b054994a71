"""A run that follows a capture process: real processes write, stall, are late and are killed."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from forked import Forked

from gsstream.cli.main import run_command
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import to_rig_coordinates
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.run.session import STREAM, run
from gsstream.input.recordings.open import open_source
from gsstream.packet import StreamReader
from gsstream.recipe.load import resolve_recipe
from tests.flow import capture
from tests.flow.flow_runs import TINY, arguments, demo_copy, encode, metrics

CAPTURE = Path(capture.__file__)
FRAMES = 4
QUICK = {"first_frame__max_iterations": 8, "stream__epochs": 1, "scale": 0.5}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished recording: three training cameras (the first is cam00), one test camera."""
    return demo_copy(tmp_path_factory.mktemp("watch") / "scene", frames=FRAMES)


@contextmanager
def capturing(finished: Path, folder: Path, fps: float = 10, **options) -> Iterator[Path]:
    """A capture process at work on ``folder`` (which has the calibration, and is named as the recording is)."""
    capture.begin(finished, folder)
    command = [sys.executable, str(CAPTURE), str(finished), str(folder), str(fps), json.dumps(options)]
    with subprocess.Popen(command) as process:
        yield folder
        process.wait(timeout=600)


def packets(stream: Path) -> list[bytes]:
    """The packets of all frames but the first, whose text names the recording's folder."""
    with StreamReader(stream) as reader:
        return [reader.read(entry) for entry in reader.frames[1:]]


def watch(source: str, out: Path, **settings) -> list[bytes]:
    """Encode without pictures; the packets after the first."""
    values = {**TINY, **{key.replace("__", "."): value for key, value in {**QUICK, **settings}.items()}}
    catalog = load_catalog()
    resolved = resolve_recipe("dense", catalog.recipe_path, (), [("test", f"{k}={v}") for k, v in values.items()])
    recording = to_rig_coordinates(open_source(source, resolved.recipe.scale))
    run(assemble(resolved, catalog), recording, prepared(out), quiet=True)
    return packets(out / STREAM)


def prepared(out: Path) -> Path:
    out.mkdir()
    return out


def follow(folder: Path, out: Path, query: str = "", **settings) -> list[bytes]:
    """Run on the growing folder, here; the packets after the first."""
    return watch(f"watch:{folder}{query}", out, **settings)


@pytest.fixture(scope="module")
def truth(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """What a run on the finished folder writes."""
    return watch(str(finished), tmp_path_factory.mktemp("watch-truth") / "run")


def test_the_stream_of_a_growing_folder_is_that_of_the_finished_one(finished: Path, tmp_path: Path) -> None:
    with capturing(finished, tmp_path / "live") as live:
        encode(tmp_path / "followed", source=f"watch:{live}", **QUICK)
    complete = json.loads((finished / "cameras.json").read_text())
    (live / "cameras.json").write_text(json.dumps(complete))
    assert encode(tmp_path / "after", source=str(live), **QUICK) == (tmp_path / "followed/stream.gss").read_bytes()
    assert len(metrics(tmp_path / "followed")) == FRAMES
    assert [line["live"] for line in metrics(tmp_path / "after")] == [None] * FRAMES
    assert "latency" not in (tmp_path / "after/summary.txt").read_text()
    live_entries = [line["live"] for line in metrics(tmp_path / "followed")]
    assert all((entry["policy"], entry["epoch_scale"], entry["absent"]) == (None, 1, []) for entry in live_entries)
    # When a packet was complete, told by its latency: after its images, in the order of frames, before its last line.
    images = [max(path.stat().st_mtime for path in live.glob(f"*/{t:06d}.jpg")) for t in range(FRAMES)]
    written = [image + entry["latency_seconds"] for image, entry in zip(images, live_entries, strict=True)]
    assert all(entry["latency_seconds"] > 0 for entry in live_entries)
    assert written == sorted(written)
    # Times of files are those of the kernel's clock tick, which may lie a hundredth of a second back.
    assert written[-1] <= (tmp_path / "followed/metrics.jsonl").stat().st_mtime + 0.02
    seconds = [sum(line["seconds"].values()) for line in metrics(tmp_path / "followed")]
    assert written[-1] - written[0] >= sum(seconds[1:]) - 0.02
    said = (tmp_path / "followed/summary.txt").read_text()
    assert f"frame 0 {live_entries[0]['latency_seconds']:.2f} s; later frames: median " in said
    assert f"of {FRAMES - 1} later frames: none was dropped, hurried or held" in said


def test_files_written_in_place_with_pauses_are_read_when_whole(
    finished: Path, tmp_path: Path, truth: list[bytes]
) -> None:
    # The pause is longer than 'settle': the size is stable in the middle of a file, and only decoding tells.
    with capturing(finished, tmp_path / "live", fps=50, slow=0.15) as live:
        assert follow(live, tmp_path / "run", "?settle=0.05") == truth


def test_a_killed_writer_ends_the_run_cleanly_before_the_half_written_frame(
    finished: Path, tmp_path: Path, truth: list[bytes]
) -> None:
    with (
        capturing(finished, tmp_path / "live", half=["cam01", 2]) as live,
        pytest.warns(UserWarning, match="ends after 2 frames") as said,
    ):
        assert follow(live, tmp_path / "run", "?timeout=1") == truth[:1]
    (text,) = (str(one.message) for one in said)
    assert "ends after 2 frames: nothing came for 1 s; frame 2 is left out (no whole image of cam01, " in text
    assert "cam01/000002.jpg: the image cannot be decoded (image file is truncated" in text


def test_a_late_camera_is_waited_for(finished: Path, tmp_path: Path, truth: list[bytes]) -> None:
    with capturing(finished, tmp_path / "live", late=["cam01", 2, 1.5]) as live:
        assert follow(live, tmp_path / "run") == truth


@pytest.mark.parametrize(("policy", "status", "done"), [("hold", "delta", "held"), ("drop", "empty", "missing")])
def test_an_absent_camera_is_held_or_its_frame_is_dropped(
    finished: Path, tmp_path: Path, truth: list[bytes], policy: str, status: str, done: str
) -> None:
    with capturing(finished, tmp_path / "live", absent=["cam01", 2]) as live:
        # It has gone on: no camera is given up because this machine is slow.
        got = follow(live, tmp_path / "run", f"?missing={policy}&grace=600")
    lines = metrics(tmp_path / "run")
    assert [line["status"] for line in lines] == ["key", "delta", status, "delta"]
    assert [line["live"]["policy"] for line in lines] == [None, None, done, None]
    assert [line["live"]["absent"] for line in lines] == [[], [], ["cam01"], []]
    assert got[0] == truth[0]
    assert got[1] != truth[1]
    assert all("psnr" in line for line in lines), "the test camera was there all the time"


def test_an_absent_camera_ends_the_run_when_the_policy_is_to_wait(finished: Path, tmp_path: Path) -> None:
    message = r"ends after 2 frames: END was written; frame 2 is left out \(no whole image of cam01\)"
    with (
        capturing(finished, tmp_path / "live", absent=["cam01", 2]) as live,
        pytest.warns(UserWarning, match=message),
    ):
        assert len(follow(live, tmp_path / "run")) == 1


def test_a_repeated_frame_is_encoded_as_the_finished_folder_has_it(finished: Path, tmp_path: Path) -> None:
    repeated = tmp_path / "repeated"
    shutil.copytree(finished, repeated)
    for folder in repeated.glob("cam*/"):
        for again in ("000002.jpg", "000003.jpg"):
            shutil.copy(folder / "000001.jpg", folder / again)
    with capturing(repeated, tmp_path / "live") as live:
        got = follow(live, tmp_path / "run", stream__change_threshold=3.0)
    assert got == watch(str(repeated), tmp_path / "after", stream__change_threshold=3.0)
    # What changed in frame 1 is worked on once more.
    assert [line["status"] for line in metrics(tmp_path / "run")] == ["key", "delta", "delta", "empty"]


@pytest.mark.parametrize(("policy", "effort"), [("drop", [0, 0, 1]), ("hurry", [0.5, 1, 1])])
def test_a_run_that_falls_behind_drops_or_hurries(
    finished: Path, tmp_path: Path, policy: str, effort: list[float]
) -> None:
    # All frames are there at once: more wait than the queue may hold, from the first look on.
    shutil.copytree(finished, tmp_path / "live")
    follow(tmp_path / "live", tmp_path / "run", f"?behind={policy}&queue=1", stream__epochs=4)
    lines = metrics(tmp_path / "run")
    assert [line["iterations"] / (4 * 3) for line in lines[1:]] == effort
    assert [line["live"]["epoch_scale"] for line in lines[1:]] == effort
    assert ["psnr" in line for line in lines] == [True, *(value > 0 for value in effort)]
    words = {0: "dropped", 0.5: "hurried", 1: None}
    assert [line["live"]["policy"] for line in lines] == [None, *(words[value] for value in effort)]


def test_interrupting_while_waiting_ends_at_once_and_resume_goes_on(
    finished: Path, tmp_path: Path, truth: list[bytes]
) -> None:
    live, out = tmp_path / "live", tmp_path / "run"
    capture.begin(finished, live)
    capture.come(finished, live, 0, 1)
    command = arguments(out, source=f"watch:{live}?timeout=60", **QUICK)
    with Forked(command) as process:
        deadline = time.monotonic() + 50
        while not (out / "metrics.jsonl").exists() or len(metrics(out)) < 2:
            assert time.monotonic() < deadline, "two frames were not encoded in time"
            time.sleep(0.05)
        time.sleep(0.3)  # now it waits for frame 2
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=15)
    assert process.returncode == 130
    assert packets(out / "stream.gss") == truth[:1]
    capture.main(finished, live, 100, {})
    assert run_command([*command, "--resume"]) == 0
    assert packets(out / "stream.gss") == truth


def test_a_run_is_resumed_whose_second_frame_lacks_the_test_camera(finished: Path, tmp_path: Path) -> None:
    """The noise of a camera is measured between the first two frames: without the second there is none to restore."""
    live, out = tmp_path / "live", tmp_path / "run"
    shutil.copytree(finished, live)
    cameras = json.loads((live / "cameras.json").read_text())["cameras"]
    (tested,) = (camera for camera in cameras if camera["split"] == "test")
    (live / (tested["frames"] % 1)).unlink()
    command = arguments(out, source=f"watch:{live}?missing=hold", **QUICK)
    assert run_command([*command, "--frames", "3"]) == 0
    assert run_command([*command, "--frames", "4", "--resume"]) == 0
    assert [sorted(line.get("psnr", {})) for line in metrics(out)] == [
        [tested["id"]],
        [],
        [tested["id"]],
        [tested["id"]],
    ]


def test_a_run_that_dropped_frames_compares_with_the_same_pictures_when_it_goes_on(tmp_path: Path) -> None:
    """By then all its frames wait, and more than the queue holds: what it made of them is not decided once more."""
    finished, live, out = demo_copy(tmp_path / "scene", frames=6), tmp_path / "live", tmp_path / "run"
    capture.begin(finished, live)

    def go(out: Path, source: str, frames: int, *more: str) -> None:
        settings = {**QUICK, "stream__change_threshold": 3.0}
        assert run_command(arguments(out, "--frames", str(frames), *more, source=source, **settings)) == 0

    capture.come(finished, live, *range(4))
    policy = f"watch:{live}?behind=drop&queue=2"
    go(out, policy, 4)
    assert [line["live"]["policy"] for line in metrics(out)] == [None, "dropped", "dropped", None]
    shutil.copytree(out, tmp_path / "other")
    capture.come(finished, live, 4, 5)
    go(out, policy, 6, "--resume")
    go(tmp_path / "other", str(finished), 6, "--resume")  # which makes no policy of what it reads
    assert packets(out / STREAM) == packets(tmp_path / "other" / STREAM)
