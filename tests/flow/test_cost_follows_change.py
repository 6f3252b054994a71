"""What a frame does not need is left out, and nothing but time depends on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from flow_runs import Witness, demo_copy, encode, metrics
from gsstream_cpu_render.renderer import CpuRenderer
from gsstream_cpu_render.session import CpuSession

from gsstream.core.context import ScreenGradient
from gsstream.engine.step import frame_step as step_module
from gsstream.engine.step import optimise as optimise_module
from gsstream.packet import StreamReader
from gsstream.parts.backend.base import ScatterSession


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(demo_copy(tmp_path_factory.mktemp("world") / "demo", frames=4))


def deltas(out: Path) -> list[bytes]:
    with StreamReader(out / "stream.gss") as reader:
        return [reader.read(entry) for entry in reader.frames[1:]]


def test_threshold_zero_is_the_dense_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: str) -> None:
    """Without a threshold every Gaussian takes part and every pixel is drawn: bit for bit a plain render per step."""
    encode(tmp_path / "ours", source=world, method="s2gs-edge", motion="still", stream__change_threshold=0)
    lines = metrics(tmp_path / "ours")
    assert [line["candidate_gaussians"] for line in lines[1:]] == [lines[1]["num_gaussians"]] * 3
    opened = CpuRenderer.open

    class Plain(ScatterSession):
        """Renders everything every time; only the gradient of the 2-D means is the native session's own."""

        def fused_views(self, *_: object) -> None:
            """Iterations are made one by one."""

        def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
            native = opened(self._renderer, self._gaussians, None, self._cameras, self._background)
            return native.screen_gradient(view, image_gradient)

    monkeypatch.setattr(CpuRenderer, "open", lambda *arguments: Plain(*arguments))
    encode(tmp_path / "plain", source=world, method="s2gs-edge", motion="still", stream__change_threshold=0)
    assert deltas(tmp_path / "ours") == deltas(tmp_path / "plain")


def test_what_the_renderer_keeps_changes_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: str) -> None:
    commits: list[int] = []
    commit = CpuSession.commit

    def counted(self: CpuSession, gaussians: Any, changed: torch.Tensor) -> Any:
        commits.append(len(changed))
        return commit(self, gaussians, changed)

    monkeypatch.setattr(CpuSession, "commit", counted)
    kept = encode(tmp_path / "kept", source=world, method="s2gs-edge")
    assert len(commits) >= 3, "one a frame, and one more where a motion was found"
    assert any(commits), "a stream in which nothing changes proves nothing"
    assert "cache" in metrics(tmp_path / "kept")[-1]
    monkeypatch.setattr(step_module, "keep", lambda *_: (None, None))
    anew = encode(tmp_path / "anew", source=world, method="s2gs-edge")
    assert kept == anew


def test_a_cache_without_room_changes_no_byte(tmp_path: Path, world: str) -> None:
    settings = {"method": "s2gs-edge", "source": world}
    encode(tmp_path / "roomy", "--set", "renderer=cpu", **settings)
    encode(tmp_path / "tight", "--set", "renderer=cpu", renderer__cache_mb=0, **settings)
    assert "cache" in metrics(tmp_path / "roomy")[-1]
    assert "cache" not in metrics(tmp_path / "tight")[-1]
    assert deltas(tmp_path / "roomy") == deltas(tmp_path / "tight")


def test_rows_behind_closed_gates_leave_and_stay_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: str
) -> None:
    sizes: list[int] = []
    narrow = CpuSession.narrow

    def counted(self: CpuSession, active: torch.Tensor) -> None:
        sizes.append(len(active))
        narrow(self, active)

    monkeypatch.setattr(CpuSession, "narrow", counted)
    monkeypatch.setattr(optimise_module, "MAX_RETAINED_SHARE", 0.95)  # few of so few rows can leave
    witness = Witness(monkeypatch)
    settings = {"motion": "still", "stream__epochs": 4}
    encode(tmp_path / "o", source=world, method="s2gs-edge", **settings)
    assert len(sizes) > 3, "some frame let rows go"
    lines = metrics(tmp_path / "o")
    assert all(line["changed_gaussians"] <= line["candidate_gaussians"] for line in lines[1:])
    for before, after, line in zip(witness.states, witness.states[1:], lines[1:], strict=False):
        moved = sum((a != b).reshape(len(a), -1).any(1) for a, b in _pairs(before, after)) > 0
        assert int(moved.sum()) <= line["changed_gaussians"]


def _pairs(before: Any, after: Any) -> list[tuple[Any, Any]]:
    ours, theirs = before.player.gaussians.items(), after.player.gaussians.items()
    return [(a, b) for (_, a), (_, b) in zip(ours, theirs, strict=True)]
