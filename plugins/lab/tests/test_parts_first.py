"""What no cell could be assembled from is said for all cells before the first of them runs, by every command."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsstream.cli.main import run_command

RECORDING = ["--source", "synthetic:frames=2&views=3&width=32&height=24"]
WRONG = {
    "gate: allways-open": "no gate named 'allways-open'; did you mean 'always-open'?",
    "gate.temprature: 3": "unknown key 'gate.params.temprature'",
    "motion: {name: rigid, params: {flowers: 1}}": "unknown key 'motion.params.flowers'",
    "growth: {name: nun}": "no growth named 'nun'; did you mean 'none'?",
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("dry", [["--dry-run"], []])
def test_a_sweep_stops_at_its_last_variant_before_its_first_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str, dry: list[str]
) -> None:
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    file.write_text(
        f"name: s\nscenes: [{{name: a, uri: '{RECORDING[1]}'}}]\nvariants:\n  - {{name: right, method: dense}}\n"
        f"  - {{name: wrong, method: dense, set: {{{wrong}}}}}\naxes: {{stream.epochs: [1, 2]}}\n"
    )
    assert run_command(["sweep", str(file), "--out", str(out), *dry]) == 2
    said = capsys.readouterr().err
    assert "cell 'a wrong stream.epochs=1 seed 0' and 1 more of 2: " in said
    assert WRONG[wrong] in said
    assert "right" not in said
    assert not out.exists()


def test_all_causes_are_said_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "sweep.yaml"
    variants = "".join(
        f"  - {{name: v{place}, method: dense, set: {{{wrong}}}}}\n" for place, wrong in enumerate(WRONG)
    )
    file.write_text(f"name: s\nscenes: [{{name: a, uri: demo}}]\nvariants:\n{variants}")
    assert run_command(["sweep", str(file), "--out", str(tmp_path / "out"), "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {len(WRONG)} problems in the recipes of the cells:\n")
    assert [cause in said for cause in WRONG.values()] == [True] * len(WRONG)


@pytest.mark.parametrize(
    "command",
    [
        ["compare", "dense,RECIPE"],
        ["search", "--method", "dense", "--try", "gate=always-open,allways-open"],
        ["tune", "--budget", "size=9KB", "--method", "dense", "--recipe", "RECIPE"],
    ],
)
def test_so_do_the_other_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]) -> None:
    recipe, out = tmp_path / "mine.yaml", tmp_path / "out"
    recipe.write_text("gate: allways-open\n")
    words = [word.replace("RECIPE", str(recipe)) for word in command]
    assert run_command([*words, *RECORDING, "--out", str(out)]) == 2
    assert "no gate named 'allways-open'; did you mean 'always-open'?" in capsys.readouterr().err
    assert not out.exists()


def test_tune_knows_no_method_of_that_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["tune", "--budget", "size=9KB", "--method", "mine.yaml", *RECORDING, "--out", str(tmp_path / "out")]
    assert run_command(command) == 2
    assert capsys.readouterr().err.startswith("error: no method named 'mine.yaml'")
