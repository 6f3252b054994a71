"""The folder of a run: what it may hold, and that one run at a time writes to it."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from gsstream_lab.gap.measure import GAP_FILES

from gsstream.core.errors import OutputError
from gsstream.engine.run import output
from gsstream.engine.run.metrics_log import append_metrics, trim_metrics
from gsstream.engine.run.output import (
    MADE_FILES,
    RUN_FILES,
    claim_output,
    disk_errors,
    ended_by_signals,
    prepare_output,
    run_lock,
    write_whole,
)
from gsstream.evaluation import gallery

HOLD = """
import sys
from pathlib import Path
from gsstream.engine.run.output import claim_output
with claim_output(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path: Path):
    """Another process that holds tmp_path / "out"."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


@pytest.mark.parametrize("how", [{}, {"overwrite": True}])
def test_a_second_run_is_told_who_holds_the_folder(how, tmp_path, holder) -> None:
    before = (tmp_path / "out" / output.LOCK).read_bytes()
    with (
        pytest.raises(OutputError, match=rf"another run works in .*process {holder.pid} on .*choose another --out"),
        claim_output(tmp_path / "out", **how),
    ):
        raise AssertionError("two runs in one folder")
    assert (tmp_path / "out" / output.LOCK).read_bytes() == before


@pytest.mark.parametrize("end", [signal.SIGKILL, None])
def test_the_lock_goes_with_its_process(end, tmp_path, holder) -> None:
    if end is None:
        holder.stdin.close()
    else:
        holder.send_signal(end)
    holder.wait()
    with claim_output(tmp_path / "out") as again:
        assert again is False
        assert json.loads((tmp_path / "out" / output.LOCK).read_text())["pid"] == os.getpid()
    assert list((tmp_path / "out").iterdir()) == [], "a finished run leaves its results and nothing else"


def test_what_is_refused_leaves_no_folder(tmp_path) -> None:
    with pytest.raises(OutputError, match="nothing to resume"), claim_output(tmp_path / "new", resume=True):
        pass
    assert not (tmp_path / "new").exists()


def test_a_lock_that_says_nothing_still_holds(tmp_path) -> None:
    with run_lock(tmp_path):
        (tmp_path / output.LOCK).write_text("")
        with pytest.raises(OutputError, match=r"another sweep works in [^(]*: wait"), run_lock(tmp_path, "sweep"):
            pass


@pytest.mark.parametrize("moment", ["write", "replace"])
def test_a_file_is_whole_or_as_before(moment, tmp_path, monkeypatch) -> None:
    path = tmp_path / "summary.txt"
    write_whole(path, "old")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail) if moment == "write" else patch.setattr(Path, "replace", fail)
        with pytest.raises(KeyboardInterrupt):
            write_whole(path, "new" * 1000)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"summary.txt": "old"}
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    plain = tmp_path / "plain"
    plain.write_text("")
    assert path.stat().st_mode == plain.stat().st_mode


FULL = "/dev/full"


@pytest.mark.skipif(not Path(FULL).exists(), reason="no device that is always full here")
def test_a_full_disk_is_one_sentence() -> None:
    with (
        pytest.raises(OutputError, match=r"No space left on device; make room\. What is complete stays valid"),
        disk_errors(Path("out")),
        open(FULL, "w", buffering=1) as file,
    ):
        file.write("x\n")


@pytest.mark.parametrize(("number", "advice"), [(errno.EROFS, "writable"), (errno.ENOENT, "do not move or delete")])
def test_other_faults_of_a_folder(number, advice, tmp_path) -> None:
    with pytest.raises(OutputError, match=advice), disk_errors(tmp_path):
        raise OSError(number, os.strerror(number), str(tmp_path / "metrics.jsonl"))


def test_other_errors_pass_unchanged(tmp_path) -> None:
    with pytest.raises(BlockingIOError), disk_errors(tmp_path):
        raise BlockingIOError(errno.EAGAIN, "again")
    with pytest.raises(KeyError), disk_errors(tmp_path):
        raise KeyError("x")


def test_a_kill_while_metrics_are_trimmed_loses_no_line(tmp_path, monkeypatch) -> None:
    path = tmp_path / "metrics.jsonl"
    path.touch()
    for frame in range(3):
        append_metrics(path, {"frame": frame})
    before = path.read_bytes()

    def killed(*_: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", killed)
        with pytest.raises(SystemExit):
            trim_metrics(path, 1)
    assert path.read_bytes() == before
    assert trim_metrics(path, 1) == [{"frame": 0}, {"frame": 1}]


def test_a_line_without_room_leaves_no_half(tmp_path) -> None:
    """In a process of its own: the limit on file sizes cannot be raised again by everybody."""
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from gsstream.engine.run.metrics_log import append_metrics\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50, 50))\n"
        "for frame in range(9): append_metrics(Path(sys.argv[1]), {'frame': frame, 'psnr': 1.5})\n"
    )
    path = tmp_path / "metrics.jsonl"
    path.touch()
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False)
    assert "OutputError" in done.stderr or "File too large" in done.stderr
    assert [json.loads(line)["frame"] for line in path.read_text().splitlines()] == [0]
    assert path.read_bytes().endswith(b"\n")


def test_a_log_that_is_deleted_while_its_run_goes_on_ends_the_run(tmp_path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*metrics.jsonl: No such file .*do not move or delete"):
        append_metrics(tmp_path / "metrics.jsonl", {"frame": 3})
    assert not (tmp_path / "metrics.jsonl").exists()


def test_what_a_shell_started_in_the_background_is_ended_by_sigterm_too() -> None:
    """There SIGINT is ignored, so passing SIGTERM on as SIGINT would end nothing."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt), ended_by_signals() as came:
            signal.raise_signal(signal.SIGTERM)
        assert came == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_of_services_arrive_as_an_interrupt(name) -> None:
    number = getattr(signal, name)
    # Under nohup the tests themselves are started with SIGHUP ignored, and then a run ignores it too (see below).
    outside = signal.signal(number, signal.SIG_DFL)
    before = signal.getsignal(number)
    stopped = threading.Event()
    previous = signal.signal(signal.SIGINT, lambda *_: stopped.set())
    try:
        with ended_by_signals() as came:
            os.kill(os.getpid(), number)
            assert stopped.wait(60)
        assert came == [number]
    finally:
        signal.signal(signal.SIGINT, previous)
        after = signal.signal(number, outside)
    assert after is before


def test_nohup_stays_nohup() -> None:
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_by_signals() as came:
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert came == []
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_a_new_folder_is_created(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    assert prepare_output(out) is False
    assert out.is_dir()


def test_a_folder_with_foreign_files_is_fine(tmp_path: Path) -> None:
    for name in ("notes.txt", "video.mp4"):
        (tmp_path / name).write_text("mine")
    assert prepare_output(tmp_path) is False
    assert prepare_output(tmp_path, overwrite=True) is False
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}, "without a run nothing is known to be ours"


@pytest.mark.parametrize("name", RUN_FILES)
def test_any_trace_of_a_run_is_respected(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(OutputError) as caught:
        prepare_output(tmp_path)
    assert f"already holds a run ({name})" in str(caught.value)
    # Only a stream can be continued: advice that the other message takes back sends the user in a circle.
    assert ("--resume" in str(caught.value)) == (name == "stream.gss")
    if name != "stream.gss":
        with pytest.raises(OutputError, match=r"nothing to resume.*--overwrite"):
            prepare_output(tmp_path, resume=True)
    assert "--overwrite" in str(caught.value)
    assert (tmp_path / name).read_bytes() == b"x"


def test_overwrite_deletes_the_files_of_a_run_and_nothing_else(tmp_path: Path) -> None:
    for name in (*RUN_FILES, *MADE_FILES, "notes.txt", "stream.gss.old"):
        (tmp_path / name).write_text(name)
    assert prepare_output(tmp_path, overwrite=True) is False
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "stream.gss.old"]


def test_made_files_are_the_ones_the_gallery_writes() -> None:
    assert set(MADE_FILES) == {gallery.SHEET, gallery.PLOTS, gallery.SUMMARY, gallery.VIDEO, *GAP_FILES}


def test_resume(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nothing to resume: .* holds no stream\.gss"):
        prepare_output(tmp_path, resume=True)
    (tmp_path / "stream.gss").write_bytes(b"x")
    assert prepare_output(tmp_path, resume=True) is True
    with pytest.raises(OutputError, match="give one of them"):
        prepare_output(tmp_path, resume=True, overwrite=True)
    assert (tmp_path / "stream.gss").read_bytes() == b"x"


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("x")
    with pytest.raises(OutputError, match="is a file; expected a folder"):
        prepare_output(tmp_path / "out", overwrite=True)
    with pytest.raises(OutputError, match="cannot be used"):
        prepare_output(tmp_path / "out" / "below")
