"""gsstream new-plugin and gsstream check: what they write, say and count, and how they exit."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import final

import numpy as np
import pytest
from distribution import write_metadata
from fresh import install, python

from gsstream.api import FitContext, Growth, Rng, RowEdit, Scene
from gsstream.cli.check import Subject, _lines
from gsstream.cli.main import run_command
from gsstream.cli.scaffold import STARTABLE
from gsstream.testing.kit import CheckResult
from gsstream.testing.method_driver import effect

#: Commands in a process that has a plugin of every kind; what each prints goes with its exit code to one JSON file.
ALL = """
import contextlib, io, json, sys
from gsstream.cli.main import run_command
results = {}
for command in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = run_command(command.split())
    results[command] = [code, out.getvalue(), err.getvalue()]
with open(sys.argv[2], "w") as file:
    json.dump(results, file)
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, str]]:
    """Command -> (exit code, stdout, stderr), in one fresh process: most of the time of one is that it starts."""
    folder = tmp_path_factory.mktemp("new")
    for kind in STARTABLE:
        assert run_command(["new-plugin", f"my-{kind}", "--kind", kind, "--out", str(folder / kind)]) == 0
        install(folder / kind, folder / "site")
    commands = [f"check {kind}/my-{kind}" for kind in STARTABLE]
    commands += ["check method/my-streaming_method", "recipe my-streaming_method"]  # a whole method is one of --method
    done = python(folder / "site", "-c", ALL, json.dumps(commands), str(folder / "results.json"), cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((folder / "results.json").read_text())


@pytest.mark.parametrize("kind", STARTABLE)
def test_passes_the_contract_untouched(kind: str, results: dict[str, tuple[int, str, str]]) -> None:
    code, out, err = results[f"check {kind}/my-{kind}"]
    assert code == 0, out + err
    assert f"{kind} my-{kind} (from gsstream-my-{kind} 0.1.0)" in out
    skipped = [line.split()[1] for line in out.splitlines() if "(skipped)" in line]
    # The example of a motion keeps on moving what moved: it fits nothing to the images, and claims so.
    assert skipped == (["motion_finds_bodies"] if kind == "motion" else [])
    assert "✓ cheap_spec" in out


def test_a_whole_method_is_one_of_the_methods(results: dict[str, tuple[int, str, str]]) -> None:
    code, out, err = results["check method/my-streaming_method"]
    assert code == 0, out + err
    assert "(skipped)" not in out
    _, out, err = results["recipe my-streaming_method"]
    assert "method: my-streaming_method" in out, err


def test_its_own_test_suite_and_lint_are_green(tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    assert run_command(["new-plugin", "my_own", "--kind", "gate", "--out", str(project)]) == 0
    install(project, site)
    result = python(site, "-m", "pytest", "-p", "no:cacheprovider", "tests", cwd=project)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "26 passed in" in result.stdout, "all but the check of formulas, which this gate does not state"
    lint = python(site, "-m", "ruff", "check", "--isolated", "--line-length=120", "--select=E,F,B", ".", cwd=project)
    assert lint.returncode == 0, lint.stdout


def test_refuses_bad_names_taken_names_and_full_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").write_text("kept")
    for args, message in (
        (["Bad Name", "--out", str(tmp_path / "a")], "expected lower case letters"),
        (["always-open", "--out", str(tmp_path / "a")], "the gate 'always-open' is already provided by gsstream"),
        (["fine", "--out", str(tmp_path)], "is not an empty folder"),
        (["fine", "--out", str(tmp_path / "mine")], "is not an empty folder"),
    ):
        assert run_command(["new-plugin", *args]) == 2
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert (tmp_path / "mine").read_text() == "kept"


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
PLUGIN = """
from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name="half", target="gsstream_half_gate:Half", summary="half open")]
"""


def test_a_sound_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "group-max"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("propagation group-max (from gsstream ")
    assert "  ✓ propagation_monotone\n" in out
    assert "  ⚠ propagation_parent_bound (skipped): not claimed: PropagationTraits.parent_bound\n" in out
    assert "22 passed, 1 skipped" in out.splitlines()[-1]


def test_kind_and_name_choose_one_of_several(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "growth/none", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("growth none (from gsstream ")
    assert "regularizer" not in out
    assert "✓" not in out


def test_packets(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check", "packets"]) == 0
    assert "10 passed" in capsys.readouterr().out


def test_a_broken_part_exits_with_1_and_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gsstream_half_gate.py").write_text(BROKEN)
    (tmp_path / "gsstream_half_plugin.py").write_text(PLUGIN)
    write_metadata(tmp_path, "gsstream-half", "0.1", "[gsstream]\nhalves = gsstream_half_plugin\n")
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
    assert run_command(["check", "structure/flat", "--set", "resolution=64", "--quiet"]) == 0
    assert run_command(["check", "structure/flat", "--set", "resolution=0"]) == 2
    assert "resolution" in capsys.readouterr().err
    assert run_command(["check", "structure/flat", "--set", "resolutions=1"]) == 2
    assert "resolutions" in capsys.readouterr().err
    assert run_command(["check", "none", "--set", "x=1"]) == 2
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
