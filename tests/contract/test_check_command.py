"""``gsstream check``: what it says, what it counts, how it exits."""

from __future__ import annotations

import re
from pathlib import Path
from typing import final

import numpy as np
import pytest

from gsstream.api import FitContext, Growth, Rng, RowEdit, Scene
from gsstream.cli.check import Subject, _lines
from gsstream.cli.main import run_command
from gsstream.testing.kit import CheckResult
from gsstream.testing.working import effect

BROKEN = '''
from typing import final
from gsstream.api import GateSampler
import torch


@final
class Half(GateSampler):
    """Half open gates."""

    source = "this test"

    @property
    def num_levels(self): return 1
    def init(self, logits): return logits.clamp(-5, 5)
    def noise(self, num_nodes, generator): return None
    def sample(self, logits, noise): return torch.full_like(logits, 0.5)
    def open_probability(self, logits): return torch.ones_like(logits)
    def bound(self, logits): return logits.clamp(-5, 5)
'''
PLUGIN = '''
from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name="half", target="gsstream_half_gate:Half", summary="half open")]
'''


def test_a_sound_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "group-max"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("propagation group-max (from gsstream ")
    assert "  ✓ propagation_monotone\n" in out
    assert "  ⚠ propagation_parent_bound (skipped): not claimed: PropagationTraits.parent_bound\n" in out
    assert "22 passed, 1 skipped" in out.splitlines()[-1]


def test_kind_and_name_choose_one_of_several(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "loss/reference", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("loss reference (from gsstream ")
    assert "renderer" not in out
    assert "✓" not in out


def test_packets(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "packets"]) == 0
    assert "10 passed" in capsys.readouterr().out


def test_a_broken_part_exits_with_1_and_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gsstream_half_gate.py").write_text(BROKEN)
    (tmp_path / "gsstream_half_plugin.py").write_text(PLUGIN)
    info = tmp_path / "gsstream_half-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: gsstream-half\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text("[gsstream]\nhalves = gsstream_half_plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("half", "gate/half", "halves", "gsstream-half"):
        assert run_command(["check", name, "--quiet"]) == 1
        out = capsys.readouterr().out
        assert "gate half (from gsstream-half 0.1)" in out
        assert "✗ gate_range_and_levels: without noise: k / num_levels: largest deviation 0.5" in out
        assert "failed" in out.splitlines()[-1]


def test_a_wrong_name_offers_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "grup-max"]) == 2
    assert "did you mean 'group-max'?" in capsys.readouterr().err
    assert run_command(["check", "doors/group-max"]) == 2
    assert "no kind of part named 'doors'" in capsys.readouterr().err


def test_settings_of_the_part_that_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "confidence/uniform", "--set", "logit=-50", "--quiet"]) == 0
    assert run_command(["check", "confidence/uniform", "--set", "logit=99"]) == 2
    assert "logit" in capsys.readouterr().err
    assert run_command(["check", "confidence/uniform", "--set", "logits=1"]) == 2
    assert "logits" in capsys.readouterr().err
    assert run_command(["check", "reference", "--set", "x=1"]) == 2
    assert "--set gives settings to one part" in capsys.readouterr().err


@final
class Thinning(Growth):
    """Half of the Gaussians leave in every frame: no check forbids it."""

    source = "this test"

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        return RowEdit(removed=np.arange(0, len(after.gaussians), 2))


def test_a_part_that_keeps_its_promises_and_spoils_the_picture_is_seen(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "growth/none"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "with it and without" in line]
    numbers = r"([\d.]+) / ([\d.]+) dB in the test camera, ([\d.]+) / ([\d.]+) KB a frame"
    same = [float(number) for number in re.findall(numbers, line)[0]]
    assert (same[0], same[2]) == (same[1], same[3]), "the null part changes nothing"
    spoiled, without, *_ = map(float, re.findall(numbers, effect("growth", Thinning(Thinning.Config())))[0])
    assert without == same[1]
    assert spoiled < without - 0.5


def test_one_cause_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    results = [CheckResult(f"check_{name}", "part", "failed", f"raised {name[:1]}") for name in ("a1", "b", "a2")]
    results.append(CheckResult("check_c", "part", "warning", "no source"))
    lines = list(_lines(Subject("part", results), quiet=True))
    assert lines == ["  ✗ 2 checks (a1, a2): raised a", "  ✗ b: raised b", "  ⚠ c (warning): no source"]
