"""The gap: fresh reconstructions are of their frame alone, kept, made once, and compared as the definitions say."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from flow_runs import encode, metrics
from gsstream_lab.gap.measure import Gap, GapView, default_frames

from gsstream.cli.main import run_command
from gsstream.input.recordings.open import open_source
from gsstream.metrics import changed_mask, psnr
from gsstream.player.playback import Playback
from gsstream.player.render import render

WORLD = "synthetic:frames=4&views=4&width=48&height=36&supersample=1&motion=4"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose frame 0 starts from a plane sweep, and its gap at frames 0 and 3."""
    out = tmp_path_factory.mktemp("gap") / "run"
    encode(out, source=WORLD, first_frame__points="auto", method="s2gs-edge", first_frame__max_iterations=120)
    assert run_command(["gap", str(out), "--at", "3,0", "--quiet"]) == 0
    return out


def test_numbers_are_those_of_the_definitions(run: Path) -> None:
    """Against the run's own measurements for the stream, and a calculation by hand for the fresh reconstruction."""
    data = json.loads((run / "gap.json").read_text())
    view = next(v for v in data["views"] if v["frame"] == 3)
    line = metrics(run)[3]
    for quantity in ("psnr", "psnr_moving", "psnr_changed"):
        assert view[quantity] == pytest.approx(line[quantity]["test"], abs=1e-3), "the renderers differ by rounding"
        assert data["gap"]["3"][quantity] == pytest.approx(view[f"fresh_{quantity}"] - view[quantity])
    first, truth = (open_source(WORLD).frame(t, "test").images[0] for t in (0, 3))
    with Playback(data["files"]["3"]) as alone:
        assert alone.frames == range(3, 4)
        image = np.clip(render(alone.state_at(3), alone.meta.test, 0, alone.meta.background), 0, 1)
    assert view["fresh_psnr_changed"] == pytest.approx(psnr(image, truth, changed_mask(truth, first)))
    assert view["fresh_psnr_changed"] > view["psnr_changed"], "two bodies far away from where the stream has them"


def test_frame_0_is_its_own_fresh_reconstruction(run: Path) -> None:
    """The recipe's own frame 0, by seeds of its own images: the same bits as a run whose recording ships no points."""
    data = json.loads((run / "gap.json").read_text())
    assert data["gap"]["0"] == {
        "psnr": 0.0,
        "psnr_moving": None,
        "psnr_changed": None,
        "psnr_seen": 0.0,
        "psnr_changed_seen": None,
    }
    with Playback(run / "stream.gss") as stream, Playback(data["files"]["0"]) as alone:
        assert stream.state_at(0).means.tobytes() == alone.state_at(0).means.tobytes()
    table = (run / "gap.txt").read_text().splitlines()
    assert [line.split()[1] for line in table[2:5]] == ["0", "3", "mean"]
    assert "test cameras: test" in table[-1]


def test_what_is_there_is_kept_and_shared_and_other_settings_are_not_taken_for_it(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = {path: path.stat().st_mtime_ns for path in (run / "fresh").iterdir()}
    assert len(kept) == 2
    assert run_command(["gap", str(run), "--at", "0,3", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == json.loads((run / "gap.json").read_text())
    assert said.err.count("kept") == 2
    assert {path: path.stat().st_mtime_ns for path in (run / "fresh").iterdir()} == kept
    # Another method's run with the same frame 0 takes them over; other passes, and points of the recording, do not.
    same = {"first_frame__points": "auto", "first_frame__max_iterations": 120}
    encode(tmp_path / "a", source=WORLD, method="s2gs-edge", stream__epochs=1, **same)
    cached = ["--cache", str(run / "fresh"), "--quiet"]
    assert run_command(["gap", str(tmp_path / "a"), "--at", "3", *cached]) == 0
    assert {path: path.stat().st_mtime_ns for path in (run / "fresh").iterdir()} == kept
    files = [json.loads((out / "gap.json").read_text())["files"] for out in (tmp_path / "a", run)]
    assert files[0] == {"3": files[1]["3"]}
    assert run_command(["gap", str(tmp_path / "a"), "--at", "3", "--epochs", "2", *cached]) == 0
    assert len(list((run / "fresh").iterdir())) == 3
    assert not list((run / "fresh").glob(".*")), "nothing unfinished stays"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--at", "4"], "the stream has frames 0 to 3, got 4"),
        (["--at", "1,x"], "expected frames such as 10,20,29"),
        (["--source", "demo"], "cameras"),
    ],
)
def test_mistakes_are_explained(
    run: Path, tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run / "gap.json").read_bytes()
    assert run_command(["gap", str(run), *more]) == 2
    assert message in capsys.readouterr().err
    assert (run / "gap.json").read_bytes() == before
    assert run_command(["gap", str(run / "stream.gss")]) == 2
    assert "expected the output folder" in capsys.readouterr().err


def test_the_usual_frames_are_a_third_two_thirds_and_the_last() -> None:
    assert default_frames(range(90)) == [30, 59, 89]
    assert default_frames(range(5, 7)) == [5, 6]
    assert default_frames(range(1)) == [0]


def test_means_are_over_cameras_first_and_leave_out_what_is_not_defined() -> None:
    views = (
        GapView(1, "a", 30, math.nan, 20, 31, 21, 31, math.nan, 22, 33, 24),
        GapView(1, "b", 32, 28, 24, 33, 25, 35, 29, 30, 37, 31),
        GapView(2, "a", 10, *[math.nan] * 4, 12, *[math.nan] * 4),
    )
    gap = Gap(views, {1: Path("x"), 2: Path("y")}, 150)
    assert gap.mean("psnr") == 20.5
    assert gap.mean("gap_psnr") == 2.0
    assert gap.mean("gap_psnr_changed") == 4.0
    assert gap.mean("gap_psnr_changed_seen") == 4.5
    assert math.isnan(gap.mean("gap_psnr_moving", 2))
    assert gap.table().splitlines()[3].split()[1::2] == ["2", "10.00", "12.00", "+2.00", *"-" * 12]


TURNED = "disturbed:ways=3:synthetic:frames=3&views=4&width=48&height=36&supersample=1&motion=4"


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over a recording that is gone through there, back and there again: pictures 0 1 2 1 0 1 2."""
    out = tmp_path_factory.mktemp("again") / "run"
    encode(out, source=TURNED, method="s2gs-edge", first_frame__max_iterations=60)
    return out


def test_what_a_stream_loses_is_what_it_has_where_the_same_pictures_come_again(
    turned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Picture 1 is shown once each way, the ends less often; all numbers against the run's own measurements."""
    assert run_command(["gap", str(turned), "--again", "--source", TURNED, "--json"]) == 0
    rows = {row.pop("frames"): row for row in json.loads(capsys.readouterr().out)}
    lines = metrics(turned)
    assert list(rows) == ["1 to 1", "3 to 3", "5 to 5", "dB in 100 frames", "frame 0", "frame 4"]
    for frame in (1, 3, 5):
        row = rows[f"{frame} to {frame}"]
        assert row["whole"] == pytest.approx(lines[frame]["psnr"]["test"], abs=1e-3)
        assert row["changed"] == pytest.approx(lines[frame]["psnr_changed"]["test"], abs=1e-3)
    by_hand = np.polyfit([1, 3, 5], [rows[f"{t} to {t}"]["whole"] for t in (1, 3, 5)], 1)[0] * 100
    assert rows["dB in 100 frames"]["whole"] == pytest.approx(by_hand)
    assert rows["frame 4"]["changed"] is None, "where the first picture is shown again, all that changed came back"
    with Playback(turned / "stream.gss") as stream:
        image = np.clip(render(stream.state_at(4), stream.meta.test, 0, stream.meta.background), 0, 1)
    truths = [open_source(TURNED.split(":", 2)[2]).frame(t, "test").images[0] for t in range(3)]
    ever = np.any([changed_mask(truth, truths[0]) for truth in truths], axis=0)
    assert rows["frame 4"]["still"] == pytest.approx(psnr(image, truths[0], ~ever))
    assert rows["frame 4"]["came back"] == pytest.approx(psnr(image, truths[0], ever))


def test_a_recording_that_shows_nothing_again_has_no_second_time(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["gap", str(run), "--again"]) == 2
    assert "disturbed:ways=3:URI" in capsys.readouterr().err
