"""A search for settings ends at a maximum, moves only for what is more than noise, and writes a recipe that runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from flow_runs import metrics
from gsstream_lab.sweep.search import MARGIN, climb
from gsstream_lab.sweep.table import read_table

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError
from gsstream.input.recordings.open import open_source
from gsstream.recipe.load import load_recipe

TINY_WORLD = "synthetic:frames=2&views=5&width=32&height=24&supersample=1"
LADDERS = {"a": (0, 1, 2, 3), "b": (0, 1, 2, 3)}


def evaluation_by(quality: Any) -> Any:
    def evaluate(settings: Mapping[str, Any], key: str, values: Sequence[Any]) -> list[float]:
        return [quality(**{**settings, key: value}) for value in values]

    return evaluate


def test_it_goes_round_until_no_key_moves() -> None:
    """The best ``a`` depends on ``b``: one round along each key ends beside the maximum, further ones reach it."""

    def quality(a: int, b: int) -> float:
        return 30 - (a - b) ** 2 - 2 * (b - 3) ** 2

    assert climb({"a": 0, "b": 0}, LADDERS, evaluation_by(quality)) == {"a": 3, "b": 3}


def test_gains_within_the_noise_move_nothing() -> None:
    assert climb({"a": 1, "b": 1}, LADDERS, evaluation_by(lambda a, b: MARGIN * a / 3)) == {"a": 1, "b": 1}


def test_what_fails_is_passed_over_and_nothing_but_failures_is_an_error() -> None:
    found = climb({"a": 0, "b": 0}, LADDERS, evaluation_by(lambda a, b: math.nan if a in (0, 3) else 20.0 + a))
    assert found["a"] == 2
    with pytest.raises(InputError, match="no value of a could be evaluated"):
        climb({"a": 0, "b": 0}, LADDERS, evaluation_by(lambda a, b: math.nan))


def test_the_better_setting_is_written_and_test_cameras_have_no_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sets = ("structure.resolution=1024", "first_frame.max_points=200")
    command = ["search", "--source", TINY_WORLD, "--method", "dense", "--out", str(tmp_path), "--workers", "1",
               "--try", "first_frame.max_iterations=0,40", *(word for s in sets for word in ("--set", s))]  # fmt: skip
    assert run_command(command) == 0
    said = capsys.readouterr().out
    assert "first_frame.max_iterations: 2000 -> " in said
    cells = read_table(tmp_path).cells.values()
    assert {cell["axes"]["first_frame.max_iterations"] for cell in cells} == {2000, 0, 40}
    names = {name for cell in cells for name in cell["frames"][0]["psnr"]}
    assert names.isdisjoint(open_source(TINY_WORLD).info.test.ids)
    best = max(cells, key=lambda cell: sum(cell["frames"][0]["psnr"].values()))["axes"]["first_frame.max_iterations"]
    recipe = load_recipe(tmp_path / "found.yaml").recipe
    assert (recipe.frames, recipe.data.split) == (None, "reporting")
    assert best in (recipe.first_frame.max_iterations, 2000)
    made = len(cells)
    assert run_command(command) == 0
    assert len(read_table(tmp_path).cells) == made, "the same command keeps what is there"
    run = ["run", "--source", TINY_WORLD, "--recipe", str(tmp_path / "found.yaml"), "--out", str(tmp_path / "run"),
           "--set", "first_frame.max_iterations=2", "--frames", "1", "--quiet", "--no-pictures"]  # fmt: skip
    assert run_command(run) == 0
    assert len(metrics(tmp_path / "run")) == 1


@pytest.mark.parametrize(
    ("tried", "problem"),
    [("first_frame.sh_degree=1", "two different values"), ("structure.resolutio=1,2", "has no such value")],
)
def test_ladders_that_are_none_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], tried: str, problem: str
) -> None:
    command = ["search", "--source", TINY_WORLD, "--method", "dense", "--out", str(tmp_path / "no"), "--try", tried]
    assert run_command(command) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
