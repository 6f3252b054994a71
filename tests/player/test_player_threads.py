"""One Playback that several threads ask: every scene is the right one, and no sound packet is called damaged."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from test_player import make_stream

from gsstream.packet import StreamReader
from gsstream.player.playback import Playback


@pytest.fixture
def impatient() -> Iterator[None]:
    """Threads take turns after a few instructions."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def scene(playback: Playback, frame: int) -> bytes:
    return b"".join(array.tobytes() for _, array in playback.state_at(frame).items())


def at_once(work, threads: int = 4) -> None:
    """Run ``work(number)`` in threads; what the first of them raises is raised."""
    failures: list[BaseException] = []

    def caught(number: int) -> None:
        try:
            work(number)
        except BaseException as error:
            failures.append(error)

    running = [threading.Thread(target=caught, args=(number,)) for number in range(threads)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()
    if failures:
        raise failures[0]


def test_every_thread_gets_the_scene_that_it_asks_for(tmp_path: Path, impatient: None) -> None:
    stream = make_stream(tmp_path / "s.gss")
    with Playback(stream) as alone:
        right = {frame: scene(alone, frame) for frame in alone.frames}
    assert len(set(right.values())) > 2

    def asks(number: int) -> None:
        rng = np.random.default_rng(number)
        for frame in rng.choice(list(right), 150):
            assert scene(shared, int(frame)) == right[int(frame)], f"frame {frame}"

    with Playback(stream) as shared:
        at_once(asks)


def test_a_packet_is_the_same_for_all_who_read_it(tmp_path: Path, impatient: None) -> None:
    with StreamReader(make_stream(tmp_path / "s.gss")) as reader:
        right = [reader.read(entry) for entry in reader.entries]

        def reads(number: int) -> None:
            rng = np.random.default_rng(number)
            for place in rng.integers(len(right), size=500):
                assert reader.read(reader.entries[place]) == right[place]

        at_once(reads)
