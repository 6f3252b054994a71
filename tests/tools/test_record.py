"""Tools of a checkout: the comparison of two, and the limit of skipped tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gsstream.packet import StreamWriter
from gsstream.packet.base import PacketKind, build_packet
from tools.record import first_difference

Sections = list[tuple[str, bytes]]


def run_of(folder: Path, *frames: tuple[PacketKind, Sections]) -> Path:
    """Write a stream of these packets below ``folder``."""
    folder.mkdir()
    with StreamWriter.open(folder / "stream.gss") as writer:
        for frame, (kind, sections) in enumerate(frames):
            writer.append(build_packet(kind, frame, sections))
    return folder


KEY: tuple[PacketKind, Sections] = (PacketKind.KEY, [("meta", b"recipe"), ("means", b"abc")])
DELTA: tuple[PacketKind, Sections] = (PacketKind.DELTA, [("gates", b"01"), ("means", b"de")])
EMPTY: tuple[PacketKind, Sections] = (PacketKind.EMPTY, [])


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ((KEY, DELTA), (KEY, DELTA), ""),
        ((KEY, DELTA), ((PacketKind.KEY, [("meta", b"another recipe"), ("means", b"abc")]), DELTA), ""),
        ((KEY, DELTA), ((PacketKind.KEY, [("meta", b"recipe"), ("means", b"abd")]), DELTA), "frame 0: means"),
        ((KEY, DELTA), (KEY, (PacketKind.DELTA, [("gates", b"01")])), "frame 1: means"),
        ((KEY, DELTA), (KEY, EMPTY), "frame 1: DELTA and EMPTY"),
        ((KEY, DELTA), (KEY,), "2 packets and 1"),
    ],
    ids=["equal", "another recipe", "another value", "a section less", "another kind", "a packet less"],
)
def test_the_first_difference_is_named(
    before: tuple[tuple[PacketKind, Sections], ...],
    after: tuple[tuple[PacketKind, Sections], ...],
    said: str,
    tmp_path: Path,
) -> None:
    assert first_difference(run_of(tmp_path / "before", *before), run_of(tmp_path / "after", *after)) == said


TESTS = """
import pytest
skip = pytest.mark.skip
@skip(reason="node is not installed (apt install nodejs)")
def test_a(): ...
@skip(reason="no page (apt install nodejs chromium)")
def test_b(): ...
@skip(reason="needs a GPU")
def test_c(): ...
def test_d(): ...
"""


@pytest.mark.parametrize(
    ("most", "code", "workers"),
    [("2", 1, []), ("2", 1, ["-n", "1"]), ("3", 0, []), (None, 0, [])],
    ids=["one too many", "one too many, a worker", "as many as may be", "no limit"],
)
def test_more_skipped_than_may_be_fails_and_says_what_to_install(
    tmp_path: Path, most: str | None, code: int, workers: list[str]
) -> None:
    (tmp_path / "test_some.py").write_text(TESTS)
    limit = ["--most-skipped", most] if most else []
    command = [sys.executable, "-m", "pytest", "-p", "conftest", *limit, *workers, "test_some.py"]
    root = Path(__file__).parents[2]
    environment = {"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    assert "To run the rest: apt install nodejs chromium\n" in done.stdout
    assert ("FAILED: 3 tests were skipped; at most 2 may be\n" in done.stdout) == (code == 1)
    assert done.stdout.splitlines()[-1].startswith(("1 passed, 3 skipped in", "====")), done.stdout
