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
    earlier = [None if state.earlier is None else state.earlier.index for state in witness.states]
    assert earlier == [None, 0, 1, None, 2]


def test_what_changed_is_worked_on_once_more(tmp_path: Path) -> None:
    """A leap is too much for the passes of one frame; nothing moves after it, and the next frame brings it nearer."""
    encode(tmp_path / "o", source=str(paused(tmp_path / "world", shown=(0, 4, 4, 4, 4))), method="s2gs-edge")
    assert kinds(tmp_path / "o") == [PacketKind.KEY, *[PacketKind.DELTA] * 2, *[PacketKind.EMPTY] * 2]
    (moving,) = zip(*(line["psnr_moving"].values() for line in metrics(tmp_path / "o")[1:]), strict=True)
    assert moving[1] > moving[0] + 0.1
    assert moving[1] == moving[2] == moving[3]


@pytest.mark.parametrize(
    ("shown", "sent"),
    [
        ((0, 1, 0, 1, 0), "DDDD"),  # all but frame 1 show pictures with which they are compared, too
        ((0, 1, 0, 0, 0), "DDDE"),
        ((0, 0, 1, 0, 0), "EDDD"),
        ((0, 1, 2, 0, 1), "DDDD"),
    ],
)
def test_a_frame_is_empty_where_nothing_changed_in_it_and_in_the_one_before(
    tmp_path: Path, shown: tuple[int, ...], sent: str
) -> None:
    encode(tmp_path / "o", source=str(paused(tmp_path / "world", shown=shown)), method="s2gs-edge")
    assert "".join(kind.name[0] for kind in kinds(tmp_path / "o")) == f"K{sent}"
    if sent == "DDDD" and len(set(shown)) == 2:
        tiles = [line["changed_tiles"] for line in metrics(tmp_path / "o")[1:]]
        assert set(tiles) == {tiles[0]}, "what changes and changes back is the same"
        assert tiles[0] > 0


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
