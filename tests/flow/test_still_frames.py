"""Frames that send little: nothing changes, too little changes, or a share is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from flow_runs import WORLD, Witness, demo_copy, encode, metrics, paused
from PIL import Image

from gsstream.packet import PacketKind, StreamReader


def kinds(out: Path) -> list[PacketKind]:
    with StreamReader(out / "stream.gss") as reader:
        return [entry.kind for entry in reader.frames]


def test_a_pause_costs_a_few_bytes_and_no_optimisation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    witness = Witness(monkeypatch)
    encode(tmp_path / "o", source=str(paused(tmp_path / "world")), method="s2gs-edge")
    # What changed in frame 1 is worked on once more in frame 2.
    assert kinds(tmp_path / "o") == [PacketKind.KEY, *[PacketKind.DELTA] * 2, PacketKind.EMPTY, PacketKind.DELTA]
    lines = metrics(tmp_path / "o")
    assert (lines[3]["iterations"], lines[3]["loss"]) == (0, 0.0)
    assert sum(lines[3]["bytes"].values()) <= 32
    before, paused_state = witness.states[2], witness.states[3]
    for (name, a), (_, b) in zip(before.player.gaussians.items(), paused_state.player.gaussians.items(), strict=True):
        assert np.array_equal(a, b), name
    # What the scene shows is still frame 2, and nothing older is compared with.
    assert paused_state.previous.index == 2
    assert [None if state.earlier is None else state.earlier.index for state in witness.states] == [
        *(None, 0, 1, None, 2),
    ]


def test_what_changed_is_worked_on_once_more(tmp_path: Path) -> None:
    """A leap is too much for the passes of one frame; nothing moves after it, and the next frame brings it nearer."""
    world = demo_copy(tmp_path / "world", frames=5)
    for camera in (path for path in world.iterdir() if path.is_dir()):
        after = (camera / "000004.jpg").read_bytes()
        for place in range(1, 4):
            (camera / f"{place:06d}.jpg").write_bytes(after)
    encode(tmp_path / "o", source=str(world), method="s2gs-edge")
    assert kinds(tmp_path / "o") == [PacketKind.KEY, *[PacketKind.DELTA] * 2, *[PacketKind.EMPTY] * 2]
    (moving,) = zip(*(line["psnr_moving"].values() for line in metrics(tmp_path / "o")[1:]), strict=True)
    assert moving[1] > moving[0] + 0.1
    assert moving[1] == moving[2] == moving[3]


def test_what_goes_there_and_back_is_seen_to_change(tmp_path: Path) -> None:
    """Frame 2 shows the pictures of frame 0, with which it is compared, too: it differs from frame 1 all the same."""
    world = demo_copy(tmp_path / "world", frames=5)
    for camera in (path for path in world.iterdir() if path.is_dir()):
        shown = [(camera / f"{place:06d}.jpg").read_bytes() for place in range(2)]
        for place in range(2, 5):
            (camera / f"{place:06d}.jpg").write_bytes(shown[place % 2])
    encode(tmp_path / "o", source=str(world), method="s2gs-edge")
    assert kinds(tmp_path / "o") == [PacketKind.KEY, *[PacketKind.DELTA] * 4]
    lines = metrics(tmp_path / "o")
    # All of frame 3 has changed since frame 2: what changed in frame 2 is the same.
    assert lines[3]["changed_tiles"] == lines[2]["changed_tiles"] == lines[1]["changed_tiles"] > 0


def test_where_everything_takes_part_a_frame_is_compared_with_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    witness = Witness(monkeypatch)
    encode(tmp_path / "o", method="s2gs-edge", stream__change_threshold=0)
    assert {state.earlier for state in witness.states} == {None}


def test_a_fade_too_slow_to_see_from_frame_to_frame_is_seen_in_the_end(tmp_path: Path) -> None:
    """One part of the picture darkens by half a grey level per frame: below the threshold each time, not together."""
    world = demo_copy(tmp_path / "world", frames=9)
    for camera in (path for path in world.iterdir() if path.is_dir()):
        first = np.asarray(Image.open(camera / "000000.jpg").convert("RGB"), np.float32)
        for place in range(9):
            image = first.copy()
            image[40:90, 40:120] -= 0.75 * place
            Image.fromarray(np.clip(np.rint(image), 0, 255).astype(np.uint8)).save(camera / f"{place:06d}.png")
    text = (world / "cameras.json").read_text().replace(".jpg", ".png")
    (world / "cameras.json").write_text(text)
    encode(tmp_path / "o", source=str(world), method="s2gs-edge")
    lines = metrics(tmp_path / "o")
    assert lines[1]["changed_tiles"] == 0
    assert any(line["iterations"] > 0 for line in lines[1:])


def test_a_frame_without_candidates_costs_nothing_and_loses_nothing(tmp_path: Path) -> None:
    """The pictures change, but no gate can open: nothing is optimised, and the loss of nothing is 0."""
    encode(tmp_path / "o", stream__active_threshold=1)
    for line in metrics(tmp_path / "o")[1:]:
        assert (line["candidate_gaussians"], line["iterations"], line["loss"]) == (0, 0, 0.0)
        assert line["changed_tiles"] > 0


#: Motions give up nothing, so a share of the whole packet is one of the residual only without them. In smaller pictures
#: decoders and headers are most of a packet, and a small share is left for rows.
EDGE = {"method": "s2gs-edge", "motion": "still", "source": WORLD.replace("64&height=48", "96&height=72")}


def sizes(out: Path) -> list[int]:
    return [sum(frame["bytes"].values()) for frame in metrics(out)]


@pytest.mark.parametrize("trim", [0.3, 0.6])
def test_the_share_is_of_the_bytes_that_are_real(tmp_path: Path, trim: float) -> None:
    whole, trimmed = tmp_path / "whole", tmp_path / "trimmed"
    encode(whole, "--frames", "2", codec__trim=0, **EDGE)
    stream = encode(trimmed, "--frames", "2", codec__trim=trim, **EDGE)
    before, after = sizes(whole), sizes(trimmed)
    assert abs(before[0] - after[0]) < 8, "a key packet is not trimmed, it only names another recipe"
    assert 0.5 * (1 - trim) * before[1] < after[1] <= (1 - trim) * before[1]
    assert len(stream) >= sum(after)
    moved = [frame["psnr_moving"]["test"] for out in (whole, trimmed) for frame in metrics(out)[1:]]
    assert all(value is None or value > 5 for value in moved)


def test_a_share_never_takes_the_whole_change(tmp_path: Path) -> None:
    """Of a packet that is mostly headers, three tenths were everything: a flash was sent as "nothing changed"."""
    encode(tmp_path, "--frames", "3", codec__trim=0.999, **EDGE)
    assert all(frame["changed_gaussians"] > 0 for frame in metrics(tmp_path)[1:])
