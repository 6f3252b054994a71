"""A method that adds and removes Gaussians on the way: player, resumed encoder and encoder stay one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flow_runs import Witness, encode

from gsstream.cli.main import run_command
from gsstream.core.changes import Rows, in_nodes, own_nodes
from gsstream.engine.step import frame_step as step_module
from gsstream.packet import StreamReader
from gsstream.player.playback import Playback


def growing(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """Every second frame splits 20 Gaussians off and removes ten."""

    def grown(parts, state, delta, view, rng):
        player = state.player
        if player.frame % 2:
            return delta
        rng = np.random.default_rng(player.frame)
        rows = np.sort(rng.choice(len(player.gaussians), 20, replace=False))
        copies = player.gaussians.rows(rows)
        copies = replace(copies, means=copies.means + rng.normal(0, 0.02, (20, 3)).astype(np.float32))
        levels = player.layout.unit_of[rows]
        if method == "dense":
            births = own_nodes(copies, levels, len(player.layout.node_counts))
        else:
            births = in_nodes(copies, player.layout.node_of[rows], levels)
        gone = np.sort(rng.choice(len(player.gaussians), 10, replace=False))
        return delta.with_rows(Rows(births, gone))

    monkeypatch.setattr(step_module, "grown", grown)


@pytest.mark.parametrize("method", ["dense", "s2gs-edge"])
def test_a_growing_scene_plays_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    growing(monkeypatch, method)
    witness = Witness(monkeypatch)
    once = encode(tmp_path / "a", method=method)
    states = list(witness.states)
    numbers = [len(state.player.gaussians) for state in states]
    assert np.diff(numbers).tolist() == [10, 0, 10, 0, 10]
    with Playback(tmp_path / "a" / "stream.gss") as playback:
        for frame, state in enumerate(states):
            theirs = playback.player_state(frame)
            state.hierarchy.validate()
            assert state.hierarchy.node_of.tolist() == theirs.layout.node_of.tolist()
            for (_, ours), (_, scene) in zip(state.player.gaussians.items(), theirs.gaussians.items(), strict=True):
                assert ours.tobytes() == scene.tobytes()
    stream = tmp_path / "a" / "stream.gss"
    with StreamReader(stream) as reader:
        entry = reader.frames[4]
    with stream.open("r+b") as file:
        file.truncate(entry.offset + 5)
    del witness.states[:]
    assert encode(tmp_path / "a", "--resume", method=method) == once
    assert len(witness.states) == 2
    for resumed, state in zip(witness.states, states[4:], strict=True):
        for name in ("node_of", "parent", "level"):
            assert getattr(resumed.hierarchy, name).tolist() == getattr(state.hierarchy, name).tolist(), name
    assert run_command(["info", str(stream)]) == 0
