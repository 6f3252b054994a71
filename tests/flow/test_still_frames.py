"""Frames in which nothing changes: almost no bytes, no optimisation, and nothing forgotten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from flow_runs import Witness, demo_copy, encode, metrics, paused
from PIL import Image

from gsstream.packet import PacketKind, StreamReader


def kinds(out: Path) -> list[PacketKind]:
    with StreamReader(out / "stream.gss") as reader:
        return [entry.kind for entry in reader.frames]


def test_a_pause_costs_a_few_bytes_and_no_optimisation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    witness = Witness(monkeypatch)
    encode(tmp_path / "o", source=str(paused(tmp_path / "world")), method="s2gs-edge")
    still = [PacketKind.EMPTY] * 2
    assert kinds(tmp_path / "o") == [PacketKind.KEY, PacketKind.DELTA, *still, PacketKind.DELTA]
    lines = metrics(tmp_path / "o")
    assert [(line["iterations"], line["loss"]) for line in lines[2:4]] == [(0, 0.0), (0, 0.0)]
    assert all(sum(line["bytes"].values()) <= 32 for line in lines[2:4])
    before, paused_state = witness.states[1], witness.states[3]
    for (name, a), (_, b) in zip(before.player.gaussians.items(), paused_state.player.gaussians.items(), strict=True):
        assert np.array_equal(a, b), name
    # What the scene shows is still frame 1.
    assert paused_state.previous.index == 1


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
