"""Recordings and results at addresses: the bytes are those of a folder, and no trouble of a store costs a frame."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import stores
from flow_runs import TINY, WORLD

from gsstream.cli.main import run_command
from gsstream.input.recordings.open import DEMO_FOLDER
from gsstream.store import mirror
from gsstream.store.cache import cache_folder
from gsstream.store.mirror import Mirror, brought_back
from gsstream.store.place import Folder, place_at

NAMES = itertools.count()
SMALL = [
    "--frames",
    "2",
    "--scale",
    "0.5",
    "--set",
    "first_frame.max_iterations=20",
    "--set",
    "first_frame.points=recording",
]
QUIET = ["--quiet", "--no-pictures"]


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[stores.Bucket]:
    with stores.bucket(f"results-{next(NAMES)}", tmp_path / "cache") as made:
        yield made


def tiny(*more: str) -> list[str]:
    settings = [word for key, value in TINY.items() for word in ("--set", f"{key}={value}")]
    return ["run", "--source", WORLD, *settings, *QUIET, *more]


def test_from_a_folder_and_from_s3_and_to_s3_the_stream_is_the_same(bucket: stores.Bucket, tmp_path: Path) -> None:
    bucket.upload(DEMO_FOLDER, "takes/pickblocks_tiny_160")
    method = ["--method", "s2gs-edge", *SMALL, *QUIET]
    there = f"{bucket.address}/takes/pickblocks_tiny_160"
    assert run_command(["run", "--source", str(DEMO_FOLDER), "--out", str(tmp_path / "here"), *method]) == 0
    assert run_command(["run", "--source", there, "--out", f"{bucket.address}/runs/a", *method]) == 0
    files = bucket.files("runs/a/")
    assert files["runs/a/stream.gss"] == (tmp_path / "here" / "stream.gss").read_bytes()
    assert files["runs/a/recording.txt"].decode() == f"{there}\n"
    assert {name.rpartition("/")[2] for name in files} == {path.name for path in (tmp_path / "here").iterdir()}
    assert not [name for name, data in files.items() if b"secret-of-the-test" in data]
    assert not list((cache_folder() / "runs").glob("*/*")), "what was brought is not kept twice"


def test_a_run_at_an_address_is_left_alone_continued_or_replaced(
    bucket: stores.Bucket, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = f"{bucket.address}/run"
    here = str(tmp_path / "here")
    for more in (["--frames", "2"], ["--frames", "4", "--resume"]):
        assert run_command(tiny("--out", here, *more)) == 0
    assert run_command(tiny("--out", out, "--frames", "2")) == 0
    before = bucket.files()
    assert run_command(tiny("--out", out)) == 2
    assert (
        f"{out} already holds a run: continue it with --resume, replace it with --overwrite" in capsys.readouterr().err
    )
    assert bucket.files() == before
    bucket.put("run/notes.txt", b"mine")
    assert run_command(tiny("--out", out, "--frames", "4", "--resume")) == 0
    assert bucket.files()["run/stream.gss"] == (tmp_path / "here" / "stream.gss").read_bytes()
    assert run_command(tiny("--out", out, "--frames", "2", "--overwrite")) == 0
    assert bucket.files()["run/stream.gss"] == before["run/stream.gss"]
    assert bucket.files()["run/notes.txt"] == b"mine"


def test_a_machine_that_is_lost_costs_only_what_was_not_brought(bucket: stores.Bucket, tmp_path: Path) -> None:
    """The process is killed and its disk is gone: the store alone is enough to go on to the same bytes."""
    long = ["--set", "stream.epochs=20", "--source", WORLD.replace("frames=6", "frames=15")]
    out = f"{bucket.address}/run"
    arguments = ["-c", "from gsstream.cli.main import main; main()", *tiny(*long, "--out", out)]
    process = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.DEVNULL)
    wait_for(lambda: bucket.files("run/stream.gss.parts/") or process.poll() is not None)
    process.kill()
    process.wait()
    parts = bucket.files("run/stream.gss.parts/")
    assert parts, "the run ended before it was killed"
    shutil.rmtree(cache_folder())
    assert run_command(tiny(*long, "--out", out, "--resume")) == 0
    assert run_command(tiny(*long, "--out", str(tmp_path / "whole"))) == 0
    files = bucket.files()
    assert files["run/stream.gss"] == (tmp_path / "whole" / "stream.gss").read_bytes()
    assert files["run/stream.gss"].startswith(b"".join(parts.values()))
    assert not [name for name in files if ".parts/" in name]


def test_the_store_is_gone_for_a_while_and_nothing_is_lost(bucket: stores.Bucket, tmp_path: Path) -> None:
    said: list[str] = []
    folder, place = tmp_path / "folder", place_at(f"{bucket.address}/run")
    folder.mkdir()
    with Mirror(folder, place, grows=["log"], say=said.append), (folder / "log").open("ab", buffering=0) as file:
        file.write(b"one\n")
        wait_for(lambda: bucket.files("run/log.parts/"))
        bucket.stop()
        file.write(b"two\n")
        wait_for(lambda: said)
        file.write(b"three\n")
        bucket.start()
    assert len(said) == 1
    assert "does not answer" in said[0]
    assert "the run goes on" in said[0]
    assert bucket.files() == {"run/log": b"one\ntwo\nthree\n"}


def test_a_store_that_never_answers_is_told_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("s3fs", reason="no S3 without s3fs")
    for name, value in {**stores.ACCOUNT, "AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_MAX_ATTEMPTS": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(mirror, "PATIENCE", 0.1)
    (tmp_path / "stream").write_bytes(b"x")
    mirrored = Mirror(tmp_path, place_at("s3://bucket/run"), grows=["stream"], say=lambda _: None)
    with pytest.raises(OSError, match="what the run says itself") as caught, mirrored:
        raise OSError("what the run says itself")
    assert f"Everything is in {tmp_path} meanwhile" in caught.value.__notes__[0]
    assert (tmp_path / "stream").read_bytes() == b"x"


def test_parts_that_the_file_no_longer_says_are_sent_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a run goes on behind a frame that the one before it wrote in another way."""
    monkeypatch.setattr(mirror, "LONGEST", 4)
    folder, place = tmp_path / "folder", Folder(tmp_path / "there")
    folder.mkdir()

    def brought(text: bytes) -> bytes:
        (folder / "log").write_bytes(text)
        made = Mirror(folder, place, grows=["log"], say=lambda _: None)
        while made._send("log"):
            pass
        brought_back(place, tmp_path / "back", grows=["log"])
        return b"".join((tmp_path / "there" / name).read_bytes() for name in place.names("log.parts/"))

    assert brought(b"abcdefghij") == b"abcdefghij"
    assert (tmp_path / "back" / "log").read_bytes() == b"abcdefghij"
    assert brought(b"abcdEFGHIJKL") == b"abcdEFGHIJKL"
    assert (tmp_path / "back" / "log").read_bytes() == b"abcdEFGHIJKL"
    assert brought(b"ab") == b"ab"


def wait_for(ready, seconds: float = 300.0) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.05)
