"""``gsstream.encode.encode``: the loop that owns encoder and file gives what a loop of one's own gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gsstream.core.errors import EndOfRecording, InputError, OutputError, UnknownName
from gsstream.core.frame import Frame
from gsstream.encode import encode, encoder_for, open_recording
from gsstream.input.recordings.base import SourceInfo, Split, Wrapped
from gsstream.packet import StreamReader, StreamWriter

WORLD = "synthetic:frames=4&views=3&width=32&height=24&supersample=1"
TINY: Mapping[str, Any] = {
    "first_frame.max_iterations": 5,
    "first_frame.points": "recording",
    "first_frame.max_points": 100,
    "stream.epochs": 1,
    "renderer": "reference",
}


def frames_in(path: Path) -> list[tuple[int, int]]:
    """(frame, bytes) of every packet by the index at the end of a stream."""
    with StreamReader(path) as reader:
        return [(entry.frame, entry.size) for entry in reader.frames]


def test_it_gives_the_packets_of_an_encoder_and_writes_them_first(tmp_path: Path) -> None:
    with open_recording(WORLD) as source:
        encoder = encoder_for("dense", source, TINY)
        expected = [encoder.encode(source.frame(index)).packet.data for index in range(4)]
        packets = []
        for step in encode("dense", source, TINY, out=tmp_path / "s.gss"):
            packets.append(step.packet.data)
            assert (tmp_path / "s.gss").stat().st_size > sum(map(len, packets)), "a killed script loses no frame"
    assert packets == expected
    assert [frame for frame, _ in frames_in(tmp_path / "s.gss")] == [0, 1, 2, 3]


def test_a_loop_that_is_left_leaves_a_whole_stream(tmp_path: Path) -> None:
    whole, left = tmp_path / "whole.gss", tmp_path / "left.gss"
    with open_recording(WORLD) as source:
        encoder = encoder_for("dense", source, TINY)
        with StreamWriter.open(whole) as writer:
            for index in range(2):
                writer.append(encoder.encode(source.frame(index)).packet)
        for step in encode("dense", source, TINY, out=left):
            if step.state.player.frame == 1:
                break
    assert left.read_bytes() == whole.read_bytes()


def test_a_setting_says_how_many_frames(tmp_path: Path) -> None:
    with open_recording(WORLD) as source:
        assert [step.status for step in encode("dense", source, {**TINY, "frames": 2})] == ["key", "delta"]


def test_what_is_wrong_is_said_before_the_loop(tmp_path: Path) -> None:
    with open_recording(WORLD) as source:
        with pytest.raises(UnknownName, match="did you mean 'dense'"):
            encode("densee", source)
        with pytest.raises(InputError, match="no slot is called gates"):
            encode("dense", source, gates="always-open")  # type: ignore[call-arg]
        (tmp_path / "there.gss").touch()
        with pytest.raises(OutputError, match="exists"):
            next(encode("dense", source, TINY, out=tmp_path / "there.gss"))


@pytest.mark.parametrize("known", [True, False], ids=["the end is known in time", "the end comes with a frame"])
def test_it_ends_with_a_recording_that_grows(known: bool) -> None:
    class Growing(Wrapped):
        """A recording that says its length after two frames, or only by having no third."""

        read = 0

        @property
        def info(self) -> SourceInfo:
            return replace(super().info, num_frames=2 if known and self.read == 2 else None)

        def frame(self, index: int, split: Split = "train") -> Frame:
            if index == 2:
                raise EndOfRecording("the recording ended after 2 frames")
            self.read += 1
            return super().frame(index, split)

    with open_recording(WORLD) as source:
        assert len(list(encode("dense", Growing(source), TINY))) == 2
