"""Key packets in the middle of a stream: by period; late join and seek."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flow_runs import WORLD, Witness, encode, metrics

from gsstream.engine.run import parts_method as method
from gsstream.packet import StreamReader, quantise_key
from gsstream.player.manifest import manifest
from gsstream.player.playback import Playback

PERIOD: dict[str, Any] = {"codec__key_interval": 2}
METHODS = ["dense", "s2gs-edge"]


def kinds(stream: Path) -> str:
    with StreamReader(stream) as reader:
        reader.check()
        return "".join(entry.kind.name[0] for entry in reader.frames)


def same(ours, theirs) -> bool:
    return all(a.tobytes() == b.tobytes() for (_, a), (_, b) in zip(ours.items(), theirs.items(), strict=True))


def rows_of(gaussians):
    """The Gaussians in an order of their own."""
    return np.unique(np.column_stack([value.reshape(len(value), -1) for _, value in gaussians.items()]), axis=0)


class Refreshed(Witness):
    """Also the states of later frames before a key packet took the place of a delta."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch)
        self.before: dict[int, Any] = {}
        original = method.key_packet_if_due

        def refresh(parts, step, *args, **named):
            self.before[step.packet.frame] = step.state
            return original(parts, step, *args, **named)

        monkeypatch.setattr(method, "key_packet_if_due", refresh)


@pytest.mark.parametrize("method", METHODS)
def test_a_key_packet_holds_the_scene_of_its_frame(tmp_path, monkeypatch, method):
    witness = Refreshed(monkeypatch)
    encode(tmp_path, method=method, **PERIOD)
    stream = tmp_path / "stream.gss"
    assert kinds(stream) == "KDKDKD"
    with Playback(stream) as playback:
        for frame, state in enumerate(witness.states):
            theirs = playback.player_state(frame)
            assert same(state.player.gaussians, theirs.gaussians)
            assert state.hierarchy.node_of.tolist() == theirs.layout.node_of.tolist()
            if frame in (2, 4):
                # The optimised scene of this very frame, as a set of rows: the key packet only orders it anew.
                mine = quantise_key(witness.before[frame].player.gaussians)
                assert np.array_equal(rows_of(mine), rows_of(theirs.gaussians))
    lines = metrics(tmp_path)
    assert [line["status"][0] for line in lines] == list("kdkdkd")
    assert [line.get("key_reason") for line in lines] == [None, None, "period", None, "period", None]
    assert all(
        sum(line["bytes"].values()) == entry["range"][1] - entry["range"][0] + 1
        for line, entry in zip(lines, manifest(stream)["packets"], strict=True)
    )


def test_a_key_packet_after_still_frames_says_which_picture_it_shows(tmp_path):
    encode(tmp_path, source=f"{WORLD}&static=1", method="s2gs-edge", **PERIOD)
    assert kinds(tmp_path / "stream.gss") == "KEKEKE"
    with Playback(tmp_path / "stream.gss") as playback:
        assert playback.player_state(4).meta.extra["shown"] == 0
