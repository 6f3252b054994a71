"""What the comparison of two checkouts says of streams that are equal, and of streams that are not."""

from __future__ import annotations

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
    before: tuple[tuple[PacketKind, Sections], ...], after: tuple[tuple[PacketKind, Sections], ...], said: str,
    tmp_path: Path,
) -> None:  # fmt: skip
    assert first_difference(run_of(tmp_path / "before", *before), run_of(tmp_path / "after", *after)) == said
