"""A recording in segments: one stream that plays, whatever order they are finished in and whoever is killed."""

from __future__ import annotations

import importlib.util
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import segment_works
from flow_runs import TINY, WORLD, encode, finish, metrics, start
from hypothesis import given
from hypothesis import strategies as st

from gsstream.cli.main import run_command
from gsstream.cli.segments import _seams
from gsstream.core.errors import GsstreamError, InputError, PacketError
from gsstream.packet import PacketKind, StreamReader
from gsstream.player.playback import Playback
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.trade.jobs.base import Finished
from gsstream.trade.jobs.executor import LocalExecutor, make_executor
from gsstream.trade.segments.carry import open_leap_recipe
from gsstream.trade.segments.drive import Setting, run_segments
from gsstream.trade.segments.job import SegmentOutcome, run_segment
from gsstream.trade.segments.join import join
from gsstream.trade.segments.plan import make_plan


class Here:
    """An executor in this process: several jobs at a time in name, finished first come first or last come first."""

    def __init__(self, slots: int, *, last_first: bool = False, work=run_segment) -> None:
        self.slots, self.last_first, self.work = slots, last_first, work
        self.jobs: list = []
        self.order: list[str] = []

    def submit(self, job) -> None:
        self.jobs.append(job)

    def next(self) -> Finished:
        job = self.jobs.pop(-1 if self.last_first else 0)
        self.order.append(job.id)
        return Finished(job.id, self.work(job))

    def close(self) -> None:
        self.jobs.clear()


def setting(method: str = "dense", *, local: bool = True) -> Setting:
    overrides = [("--set", f"{key}={value}") for key, value in TINY.items() if method != "hold" or "first" in key]
    resolved = resolve_recipe(method, load_catalog().recipe_path, (), overrides)
    return Setting(WORLD, resolved, resolved, local)


def made(out: Path, executor, start="warm", method: str = "dense", *, segments: int = 3, local: bool = True) -> bytes:
    out.mkdir(exist_ok=True)
    plan = make_plan(6, segments, start, first_given=False)
    run_segments(plan, setting(method, local=local), out, executor, say=lambda _: None)
    return (out / "stream.gss").read_bytes()


@given(frames=st.integers(1, 400), segments=st.integers(1, 60), first=st.booleans(), anew=st.booleans())
def test_a_plan_covers_every_frame_once_and_depends_on_nothing_later(frames, segments, first, anew) -> None:
    start = "anew" if anew else "warm"
    if frames < 2 * segments:
        with pytest.raises(InputError, match=f"the recording has {frames}"):
            make_plan(frames, segments, start, first_given=first)
        return
    plan = make_plan(frames, segments, start, first_given=first)
    assert [index for task in plan.segments for index in task.frames] == list(range(frames))
    lengths = {len(task.frames) for task in plan.segments}
    assert max(lengths) - min(lengths) <= 1
    ends = {task.id: task.frames.stop - 1 for task in plan.keys} | {"first": 0}
    have = {"first"} if first else set()
    for task in (*plan.keys, *plan.segments):
        assert task.after is None or task.after in have
        have.add(task.id)
    for task in plan.segments:
        assert task.after is not None
        assert ends[task.after] == task.frames.start, "it starts from the scene of its own first frame"
    for task in plan.keys:
        assert (task.shown is None) == (task.after is None)
        if task.after:
            assert ends[task.after] == task.shown


@pytest.fixture(scope="module", params=["warm", "anew"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, bytes]:
    """(start, folder, stream) of three segments made one after the other."""
    out = tmp_path_factory.mktemp("whole")
    return request.param, out, made(out, Here(1), request.param)


def test_the_joined_stream_is_the_segments_bit_by_bit(whole: tuple[str, Path, bytes]) -> None:
    _, out, _ = whole
    with StreamReader(out / "stream.gss") as reader:
        reader.check()
        assert reader.damage is None
        assert [entry.frame for entry in reader.frames] == list(range(6))
        keys = [entry.frame for entry in reader.frames if entry.kind == PacketKind.KEY]
    assert keys == [0, 2, 4]
    with Playback(out / "stream.gss") as joined:
        scenes = dict(joined)
        for k in range(3):
            with Playback(out / f"segment-{k:03d}" / "stream.gss") as part:
                assert list(part.frames) == [2 * k, 2 * k + 1]
                for frame, scene in part:
                    for name, value in scene.items():
                        assert np.array_equal(value, getattr(scenes[frame], name)), (frame, name)
        assert np.array_equal(joined.state_at(3).means, scenes[3].means), "joined in the middle"
    assert [line["frame"] for line in metrics(out)] == list(range(6))
    assert all(line["psnr_moving"] for line in metrics(out))


def test_the_order_of_completion_changes_no_byte(whole: tuple[str, Path, bytes], tmp_path: Path) -> None:
    start, _, once = whole
    executor = Here(3, last_first=True)
    assert made(tmp_path / "o", executor, start) == once
    assert executor.order != sorted(executor.order)


def test_workers_that_share_no_folder_give_the_same_bytes(whole: tuple[str, Path, bytes], tmp_path: Path) -> None:
    start, _, once = whole
    assert made(tmp_path / "o", Here(2), start, local=False) == once


def test_moving_pixels_are_those_of_a_run_from_the_start(whole: tuple[str, Path, bytes], tmp_path: Path) -> None:
    """Frame 0 and the noise are the recording's, not the segment's: quality is compared on the same pixels."""
    encode(tmp_path / "run", first_frame__points="auto")
    alone = metrics(tmp_path / "run")
    for ours, theirs in zip(metrics(whole[1]), alone, strict=True):
        moving = [{name for name, value in line["psnr_moving"].items() if value is not None} for line in (ours, theirs)]
        assert moving[0] == moving[1], ours["frame"]
    first = metrics(whole[1])[0]
    assert first["psnr"] == alone[0]["psnr"], "segment 0 begins as the run does"


def test_an_open_leap_frees_every_gaussian_and_the_segment_is_the_method_s_own(tmp_path: Path) -> None:
    overrides = [("--set", f"{key}={value}") for key, value in TINY.items()]
    overrides += [("--set", "budget.size=400"), ("--set", "budget.memory=8GB"), ("--set", "scale=0.5")]
    resolved = resolve_recipe("s2gs-edge", load_catalog().recipe_path, (), overrides)
    leap = open_leap_recipe(resolved, 2)
    plan = make_plan(6, 2, "open", first_given=False)
    run_segments(plan, Setting(WORLD, resolved, leap), tmp_path, Here(1), say=lambda _: None)
    changed = metrics(tmp_path / "key-001")[1]
    assert (changed["active_gaussians"], changed["status"]) == (changed["num_gaussians"], "delta")
    assert sum(changed["bytes"].values()) > 400, "the budget of a frame does not bind what is not sent"
    assert (leap.recipe.budget.memory, leap.recipe.scale) == (8e9, 0.5)
    assert leap.recipe.structure == resolved.recipe.structure
    with Playback(tmp_path / "stream.gss") as playback:
        first, later = playback.player_state(0), playback.player_state(3)
        for state in (first, later):
            assert state.meta.recipe == first.meta.recipe
            assert state.meta.recipe["gate"]["name"] == "gumbel-sigmoid"
        levels = [np.sort(state.layout.unit_of) for state in (first, later)]
    assert np.array_equal(*levels), "what a Gaussian's residuals are measured in goes on"


def test_a_whole_method_in_segments(tmp_path: Path) -> None:
    made(tmp_path, Here(2), method="hold", segments=2)
    with Playback(tmp_path / "stream.gss") as playing:
        scenes = [scene for _, scene in playing]
    assert np.array_equal(scenes[5].means, scenes[0].means)


def test_a_worker_killed_in_a_segment_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("SEGMENT_TEST_MARKS", str(marks))
    once = made(tmp_path / "once", Here(1), segments=2)
    out, said = tmp_path / "o", []
    out.mkdir()
    executor = LocalExecutor(2, 1, segment_works.run_and_die_once, ["gsstream.trade.jobs.warm"])
    plan = make_plan(6, 2, "warm", first_given=False)
    run_segments(plan, setting(), out, executor, say=said.append)
    assert (out / "stream.gss").read_bytes() == once
    assert (marks / "dead").exists()
    assert [line for line in said if "killed by SIGKILL" in line and "goes on" in line]
    steps = [path.name.split("-")[2] for path in marks.glob("segment-001-*")]
    assert sorted(steps) == ["4", "4", "5"], "frame 3, the key packet, was kept; frame 4 was made again"


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray (extra: ray)")
@pytest.mark.slow
def test_on_ray_a_killed_worker_s_segment_begins_again_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster of two workers that share no folder with the run; frame 0 is given, one worker fewer to wait for."""
    marks, once, out = tmp_path / "marks", tmp_path / "once", tmp_path / "o"
    marks.mkdir()
    out.mkdir()
    wanted = made(once, Here(1), segments=2)
    monkeypatch.setenv("SEGMENT_TEST_MARKS", str(marks))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    shutil.copyfile(once / "key-000" / "stream.gss", out / "first.gss")
    said: list[str] = []
    executor = make_executor(segment_works.run_and_die_once, 2, 1, "local")
    result = run_segments(
        make_plan(6, 2, "warm", first_given=True), setting(local=False), out, executor, say=said.append
    )
    assert (result.made, (out / "stream.gss").read_bytes()) == (3, wanted)
    assert sum("Ray worker was lost" in line and "goes on" in line for line in said) == 1
    steps = [path.name.split("-")[2] for path in marks.glob("segment-001-*")]
    assert sorted(steps) == ["4", "4", "5"]


def test_without_ray_nothing_is_touched(
    whole: tuple[str, Path, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(whole[1], tmp_path, dirs_exist_ok=True)
    (tmp_path / "segments.json").write_text("{}")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.setitem(sys.modules, "ray", None)
    command = ["run-segments", "--method", "dense", "--source", WORLD, "--segments", "3", "--ray", "local"]
    assert run_command([*command, "--overwrite", "--out", str(tmp_path)]) == 1
    assert "gsstream[ray]" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_killed_run_resumes_and_keeps_what_is_finished(tmp_path: Path) -> None:
    sets = [item for key, value in TINY.items() for item in ("--set", f"{key}={value}")]
    command = ["run-segments", "--source", WORLD, "--method", "dense", "--segments", "3", "--workers", "2", *sets]
    command += ["--no-pictures", "--out"]
    code, _, err = finish(*command, str(tmp_path / "once"), "--quiet")
    assert (code, err) == (0, "")
    out = tmp_path / "o"
    process = start(*command, str(out), "--quiet")
    deadline = time.monotonic() + 100
    while not (out / "segment-000" / "metrics.jsonl").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert not (out / "stream.gss").exists()
    code, said, err = finish(*command, str(out), "--resume")
    assert (code, err) == (0, "")
    assert (out / "stream.gss").read_bytes() == (tmp_path / "once" / "stream.gss").read_bytes()
    assert " kept" in said
    assert " 0 kept" not in said
    assert "SEAM" in said
    assert not (out / "contact_sheet.png").exists()


@pytest.mark.parametrize("lost", ["half a line", "the key frame's line"])
def test_metrics_that_a_kill_cut_short_lose_a_line_and_no_more(
    whole: tuple[str, Path, bytes], tmp_path: Path, lost: str
) -> None:
    """The packet is on disk before its line: a stream can be whole where its metrics are not."""
    start, made_once, once = whole
    shutil.copytree(made_once, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "segment-001" / "metrics.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text(lines[0] + lines[1][:-9] if lost == "half a line" else lines[1])
    plan = make_plan(6, 3, start, first_given=False)
    result = run_segments(plan, setting(), tmp_path, Here(1), say=lambda _: None)
    assert (result.made, (tmp_path / "stream.gss").read_bytes()) == (0, once)
    missing = 3 if lost == "half a line" else 2
    assert [line["frame"] for line in metrics(tmp_path)] == [frame for frame in range(6) if frame != missing]
    first, second = result.seams
    assert (first.frame, first.key_bytes is None) == (2, lost != "half a line")
    assert (first.at is None, second.before is None) == (lost != "half a line", lost == "half a line")
    assert "-" in _seams(result)


def test_a_segment_that_fails_says_which_and_keeps_the_others(tmp_path: Path) -> None:
    def fails(job):
        return SegmentOutcome(job.id, "SourceError: camera gone") if job.id == "segment-001" else run_segment(job)

    with pytest.raises(GsstreamError, match=r"segment-001: frames 2 to 3 failed: SourceError: camera gone.*--resume"):
        made(tmp_path, Here(1, work=fails))
    assert not (tmp_path / "stream.gss").exists()
    mended = Here(1)
    made(tmp_path, mended)
    assert "segment-000" not in mended.order
    assert "key-000" not in mended.order


def test_frame_0_of_another_stream_is_its_first_frame_alone(tmp_path: Path) -> None:
    encode(tmp_path / "run", "--frames", "3")
    sets = [item for key, value in TINY.items() for item in ("--set", f"{key}={value}")]
    command = ["run-segments", "--source", WORLD, "--method", "dense", "--segments", "2", "--workers", "2", *sets]
    command += ["--no-video", "--quiet", "--first-frame", str(tmp_path / "run"), "--out", str(tmp_path / "o")]
    assert run_command(command) == 0
    assert metrics(tmp_path / "o")[0]["psnr"] == metrics(tmp_path / "run")[0]["psnr"]
    assert not (tmp_path / "o" / "key-000").exists()
    assert (tmp_path / "o" / "contact_sheet.png").exists()


def test_streams_that_do_not_follow_each_other_are_not_joined(whole: tuple[str, Path, bytes], tmp_path: Path) -> None:
    parts = [whole[1] / f"segment-{k:03d}" / "stream.gss" for k in range(3)]
    with pytest.raises(PacketError, match="frames must be consecutive: expected 2, got 4"):
        join([parts[0], parts[2]], tmp_path / "out.gss")
    torn = tmp_path / "torn.gss"
    torn.write_bytes(parts[1].read_bytes()[:-40])
    damaged = bytearray(parts[1].read_bytes())
    damaged[len(damaged) // 2] ^= 1
    torn.write_bytes(damaged)
    with pytest.raises(PacketError, match="damaged"):
        join([parts[0], torn], tmp_path / "out.gss")
    assert not (tmp_path / "out.gss").exists()


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: tuple[str, Path, bytes]) -> None:
    def refused(*more: str) -> str:
        assert run_command(["run-segments", "--method", "dense", "--quiet", "--no-pictures", *more]) == 2
        return capsys.readouterr().err

    world = ("--source", WORLD)
    err = refused(*world, "--segments", "4", "--out", str(tmp_path / "a"))
    assert "--segments 4: a segment has at least 2 frames, the recording has 6; expected 1 to 3" in err
    (tmp_path / "live").mkdir()
    out = tmp_path / "held"
    out.mkdir()
    (out / "stream.gss").write_bytes(b"kept")
    assert "already holds a run" in refused(*world, "--segments", "2", "--out", str(out))
    assert (out / "stream.gss").read_bytes() == b"kept"
    assert "nothing to resume" in refused(*world, "--segments", "2", "--out", str(out), "--resume")
    (out / "segments.json").write_text('{"segments": 3}')
    err = refused(*world, "--segments", "2", "--out", str(out), "--resume")
    assert "was begun with other settings" in err
    assert "segments" in err
    assert "already holds a run in segments" in refused(*world, "--segments", "2", "--out", str(out))
    err = refused(*world, "--segments", "2", "--out", str(tmp_path / "b"), "--method", "hold", "--start", "open")
    assert "--start open: expected a method made of parts, got the stepper 'hold'" in err
