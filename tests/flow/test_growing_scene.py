"""A method that adds and removes Gaussians on the way: player and encoder stay one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from flow_runs import Witness, encode, growing

from gsstream.cli.main import run_command
from gsstream.player.playback import Playback


@pytest.mark.parametrize("method", ["dense", "s2gs-edge"])
def test_a_growing_scene_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    growing(monkeypatch, method)
    witness = Witness(monkeypatch)
    encode(tmp_path / "a", method=method)
    numbers = [len(state.player.gaussians) for state in witness.states]
    assert np.diff(numbers).tolist() == [10, 0, 10, 0, 10]
    with Playback(tmp_path / "a" / "stream.gss") as playback:
        for frame, state in enumerate(witness.states):
            theirs = playback.player_state(frame)
            state.hierarchy.validate()
            assert state.hierarchy.node_of.tolist() == theirs.layout.node_of.tolist()
            for (_, ours), (_, scene) in zip(state.player.gaussians.items(), theirs.gaussians.items(), strict=True):
                assert ours.tobytes() == scene.tobytes()
    assert run_command(["info", str(tmp_path / "a" / "stream.gss")]) == 0
