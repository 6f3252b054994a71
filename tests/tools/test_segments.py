"""Segments that are measured against the whole: they are one stream, and the first of them is its beginning."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import open_recording
from gsstream.packet import PacketKind, StreamWriter
from gsstream.player.playback import Playback
from tools.segments import LEAP, Made, Recipes, encoded, row


def test_segments_are_one_stream_that_begins_as_the_whole_does(tmp_path: Path) -> None:
    recipe = Recipes("s2gs-edge", [], ["scale=0.25", "first_frame.max_iterations=10", "stream.epochs=1"])
    source = open_recording("demo", recipe.resolved().recipe, load_catalog())
    whole = encoded(source, recipe, frames=5, length=5)
    made = encoded(source, recipe, frames=5, length=2, first=whole.packets[0])
    keys = [packet.frame for packet in made.packets if packet.kind == PacketKind.KEY]
    assert (keys, len(made.leaps), [len(steps) for steps in made.later]) == ([0, 2, 4], 2, [1, 1, 0])
    assert [packet.data for packet in made.packets[:2]] == [packet.data for packet in whole.packets[:2]]
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in made.packets:
            writer.append(packet)
    with Playback(tmp_path / "s.gss") as playback:
        assert list(playback.frames) == list(range(5))
        assert all(len(playback.state_at(frame)) > 0 for frame in playback.frames)


class Quality:
    """An evaluation without views."""

    views = ()


def test_speed_is_that_of_the_longest_way() -> None:
    """Three segments of four frames: leaps follow each other, and the last segment is done last."""
    packets = [type("Packet", (), {"data": b""})()] * 12
    whole = Made(packets, [], [[1.0] * 11])
    made = Made(packets, [LEAP / 3.0] * 2, [[1.0] * 3] * 3)
    assert made.longest_later() == pytest.approx(2 * LEAP / 3 + 3)
    found = row(made, Quality(), whole, length=4)
    assert found["times_as_fast"] == pytest.approx(11 / (2 * LEAP / 3 + 3), abs=0.005)
    assert found["of_the_model"] == pytest.approx(11 / (2 * LEAP / 3 + 3) * (2 * LEAP + 4) / 12, abs=0.005)
    assert found["frames_of_a_leap"] == pytest.approx(LEAP / 3)
