"""Whole runs, tiny: added Gaussians on the wire, the player's state, settings from the recipe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gsstream_queen import frame as frame_module
from gsstream_queen import method as method_module

from gsstream.cli.main import run_command
from gsstream.core.frame import Frame
from gsstream.engine.run.encoder import Encoder
from gsstream.packet import PacketKind
from gsstream.player.playback import Playback

SOURCE = "synthetic:frames=5&views=3&width=64&height=48&supersample=1"
SETTINGS = {
    "first_frame.max_iterations": 40,
    "first_frame.max_points": 500,
    "first_frame.points": "recording",
    "stream.epochs": 3,
    "streaming_method.growth.every": 1,
    "streaming_method.growth.grad_threshold": 1e-4,
    "streaming_method.growth.max_added": 30,
    "streaming_method.change.dynamic": 1e-7,
}


def encode(out: Path, *more: str, source: str = SOURCE, **changes: Any) -> bytes:
    values = {**SETTINGS, **{key.replace("__", "."): value for key, value in changes.items()}}
    sets = [item for key, value in values.items() for item in ("--set", f"{key}={value}")]
    command = ["run", "--source", source, "--method", "queen", "--out", str(out), "--quiet", "--no-pictures", *sets]
    assert run_command([*command, *more]) == 0
    return (out / "stream.gss").read_bytes()


def metrics(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any], list[Any]]:
    """(folder, encoder state after every frame, (problem, result) of every optimised frame) of one run."""
    out, states, solved = tmp_path_factory.mktemp("watched"), [], []
    patch = pytest.MonkeyPatch()

    encoded = Encoder.encode

    def remember(encoder: Encoder, frame: Frame) -> Any:
        step = encoded(encoder, frame)
        states.append(step.state)
        return step

    def solve(config, problem, generator):
        run = frame_module.optimise(config, problem, generator)
        solved.append((problem, run))
        return run

    patch.setattr(Encoder, "encode", remember)
    patch.setattr(method_module, "optimise", solve)
    encode(out)
    patch.undo()
    return out, states, solved


def test_what_was_trained_is_what_was_sent(watched) -> None:
    """The rows of the last forward pass against the decoded packet: only half-float decoders lie between them."""
    out, states, solved = watched
    assert len(solved) == 4
    for what in ("added_gaussians", "removed_gaussians"):
        assert sum(line.get(what, 0) for line in metrics(out)) > 0, "no rows came and went: it proves too little"
    for before, after, (problem, result) in zip(states, states[1:], solved, strict=False):
        delta = after.player.delta
        assert delta is not None
        residual, gates = delta.residual, delta.gates(before.player.layout)
        assert residual is not None
        for name, table in result.solution.symbols.items():
            if name in residual.symbols:
                nodes = before.player.layout.node_of[problem.active.numpy()]
                kept = ~result.gone[problem.active].numpy() & gates[nodes].astype(bool)
                np.testing.assert_array_equal(residual.symbols[name], table.numpy()[kept], err_msg=name)
        for name, sent in residual.decoders.items():
            np.testing.assert_allclose(sent, result.solution.decoders[name].numpy(), rtol=1e-3, atol=1e-6)
        stay = np.delete(np.arange(len(before.player.gaussians)), delta.removed)
        moved = after.player.gaussians.means[: len(stay)] - before.player.gaussians.means[stay]
        closed = gates[before.player.layout.node_of[stay]] == 0
        assert not moved[closed].any()


def test_a_static_recording_costs_headers(tmp_path: Path) -> None:
    encode(tmp_path, source=f"{SOURCE}&static=1")
    with Playback(tmp_path / "stream.gss") as playback:
        entries = [playback.entry(frame) for frame in playback.frames]
    assert [entry.kind for entry in entries[1:]] == [PacketKind.EMPTY] * 4


def test_policies_decide_what_is_sent(tmp_path: Path) -> None:
    """Only sh0 may change: no other section is in any packet, and centres keep their bits."""
    frozen = {
        f"streaming_method__{name}__policy": "frozen" for name in ("means", "quats", "scales", "opacities", "shN")
    }
    encode(tmp_path, streaming_method__growth__every=0, streaming_method__sh0__lr=0.3, **frozen)
    with Playback(tmp_path / "stream.gss") as playback:
        first, last = playback.state_at(0), playback.state_at(4)
    assert first.means.tobytes() == last.means.tobytes()
    assert first.sh0.tobytes() != last.sh0.tobytes()
    for line in metrics(tmp_path)[1:]:
        assert set(line["bytes"]) <= {"gates", "pattern", "decoders", "sh0", "header"}


def test_gates_close_where_they_cost(tmp_path: Path) -> None:
    """A heavy L0 leaves fewer centres moving than none."""
    moving = []
    for name, weight in (("free", 0.0), ("dear", 100.0)):
        settings = {"streaming_method__gate__l0": weight, "streaming_method__growth__every": 0, "stream__epochs": 8}
        encode(tmp_path / name, "--frames", "3", **settings)
        moving.append(sum(line["moved_gaussians"] for line in metrics(tmp_path / name)[1:]))
    assert moving[1] < moving[0]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("streaming_method.sh0.latnt=3", "unknown key 'streaming_method.params.sh0.latnt'; did you mean 'latent'?"),
        (
            "streaming_method.gate.l0=-1",
            "streaming_method.params.gate.l0: input should be greater than or equal to 0, got -1",
        ),
        ("stream.rd_lambda=0.5", "stream.rd_lambda: the streaming_method 'queen' does not read it"),
    ],
)
def test_wrong_settings_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], setting: str, message: str
) -> None:
    command = ["run", "--source", SOURCE, "--method", "queen", "--out", str(tmp_path / "o"), "--set", setting]
    assert run_command(command) == 2
    assert message in capsys.readouterr().err
