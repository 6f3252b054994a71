"""The film of the README: what it shows is what was printed and what the stream holds."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsstream.packet import StreamWriter
from gsstream.play import Playback
from tests.web.moving_scenes import moving_packets
from tools.film import ORANGE, SIZE, Line, compared, moving, record, sizes, terminal, write


@pytest.fixture
def stream(tmp_path: Path) -> Iterator[Playback]:
    with StreamWriter.open(tmp_path / "stream.gss") as writer:
        for packet in moving_packets(seed=1, frames=4, number=40, key_at=99):
            writer.append(packet)
    with Playback(tmp_path / "stream.gss") as playback:
        yield playback


def test_lines_are_those_that_a_program_prints_in_their_order(tmp_path: Path) -> None:
    code = "import sys; print('one'); print('two', file=sys.stderr)"
    first, second = record([sys.executable, "-c", code], tmp_path)
    assert (first.text, second.text) == ("one", "two")
    assert 0 < first.at <= second.at
    with pytest.raises(RuntimeError, match=r"(?s)ended with 3.*why"):
        record([sys.executable, "-c", "print('why'); raise SystemExit(3)"], tmp_path)


def test_lines_come_as_many_times_faster_as_is_said() -> None:
    lines = [Line(1.0, "a"), Line(4.0, "b"), Line(4.0, "c"), Line(31.0, "d")]
    typed = len(list(terminal("ls", [])))
    once, thrice = ([s.stays for s in terminal("ls", lines, speed)][typed - 1 : -1] for speed in (1, 3))
    assert once == [1000, 3000, 1, 27000]
    assert thrice == [333, 1000, 1, 9000]


def test_every_line_changes_the_screen_however_many_there_are() -> None:
    shots = list(terminal("ls", [Line(i, f"line {i} " + 100 * "x") for i in range(50)]))
    screens = [np.asarray(shot.image) for shot in shots]
    assert all((one != other).any() for one, other in pairwise(screens))
    assert all(screen[-3:, :].max() == screen[0, 0].max() for screen in screens), "text runs over the lower edge"


def test_bars_are_as_high_as_frames_are_large(stream: Playback) -> None:
    *_, last = sizes(stream)
    rows = (np.asarray(last.image) == ORANGE).all(-1).sum(0)
    starts = np.flatnonzero((rows[1:] > 0) & (rows[:-1] == 0)) + 1
    later = np.array([stream.entry(frame).size for frame in stream.frames[1:]])
    assert len(starts) == len(later)
    assert np.allclose(rows[starts] / rows[starts].max(), later / later.max(), atol=0.02)


def test_a_short_film_holds_every_shot_for_its_time(stream: Playback, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shots = [*moving(stream, 6), *compared(stream, rng.random((24, 32, 3), np.float32)), *sizes(stream)]
    assert {shot.image.size for shot in shots} == {SIZE}
    out = tmp_path / "film.webp"
    write(shots, out)
    with Image.open(out) as film:
        stays = []
        for place in range(film.n_frames):
            film.seek(place)
            film.load()
            stays.append(film.info["duration"])
        assert film.info["loop"] == 0
    assert sum(stays) == sum(shot.stays for shot in shots)
