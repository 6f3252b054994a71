"""Tuning and searching: which candidates, which of them fits, and small pilots that write recipes."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from flow_runs import WORLD, encode, metrics
from gsstream_lab.report.groups import read_sweep_data
from gsstream_lab.sweep.search import MARGIN, climb
from gsstream_lab.sweep.table import read_table
from gsstream_lab.sweep.tune import Trial, candidates, choose, nearest, trial_of, tune_table

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError
from gsstream.input.recordings.open import open_source
from gsstream.recipe.budget import Budget
from gsstream.recipe.load import load_recipe
from gsstream.recipe.model import Recipe

TINY = ["first_frame.max_iterations=20", "first_frame.max_points=400", "stream.epochs=2"]


def trial(name: str, moving: float, size: int, inside: int = 4, frames: int = 4) -> Trial:
    return Trial(name, moving + 2, moving, (size,) * frames, (0.5,) * frames, 5e8, inside)


def row(*frames: tuple[int, float], status: str = "done") -> dict:
    """A table's cell: (bytes, wall seconds) by frame; processor time is twice the wall's."""
    made = [
        {
            "frame": t,
            "bytes": {"a": size - 1, "b": 1},
            "seconds": {"x": s},
            "cpu_seconds": 2 * s,
            "peak_memory_mb": 300.0,
            "psnr": {"c": 30.0 + t},
            "psnr_moving": {"c": None if t == 1 else 20.0 + t},
        }
        for t, (size, s) in enumerate(frames)
    ]
    return {"status": status, "frames": made, "error": "it broke"}


def test_candidates_follow_what_is_limited() -> None:
    names = [v.name for v in candidates(["m"], Budget(size=1000))]
    assert names == ["m", "m+rate-1e-3", "m+rate-3e-3", "m+budget"]
    names = [v.name for v in candidates(["m", "n"], Budget(time=1.0))]
    assert names == ["m", "m+epochs-4", "m+change-12", "m+budget", "n", "n+epochs-4", "n+change-12", "n+budget"]
    only = candidates(["m"], Budget(memory=10**9))
    assert [(v.name, v.set) for v in only] == [("m", {"budget.memory": 10**9})]
    both = candidates(["m"], Budget(memory=10**9, size=1000))[-1]
    assert both.set == {"budget.memory": 10**9, "budget.size": 1000}


def test_a_trial_is_held_against_every_limit() -> None:
    cell = row((90_000, 9.0), (1000, 1.0), (900, 0.4), (1001, 0.4))
    found = trial_of("x", cell, Budget(size=1000, time=1.0))
    assert (found.inside, found.frames, found.fits) == (2, 3, False)
    assert (found.psnr, found.moving) == (32.0, 22.5)
    assert trial_of("x", cell, Budget(size=1001, time=1.0)).fits
    assert trial_of("x", cell, Budget(time=0.5)).inside == 2
    assert trial_of("x", cell, Budget(memory=299_000_000)).inside == 0
    assert trial_of("x", row(status="failed"), Budget(size=99)).error == "it broke"


def test_the_best_that_fits_is_chosen() -> None:
    large, good, cheap = trial("large", 30.0, 9000, inside=3), trial("good", 29.0, 5000), trial("cheap", 28.99, 4000)
    assert choose([large, good, cheap, trial("poor", 28.0, 10)]) is cheap, "a tie within 0.02 dB: fewer bytes"
    assert choose([large, trial("good", 29.0, 5000), trial("poor", 28.0, 10)]).name == "good"  # type: ignore[union-attr]
    assert choose([large]) is None
    assert nearest([large, trial("far", 31.0, 100, inside=0), Trial("broken", error="x")]) is large
    assert nearest([Trial("broken", error="x")]) is None
    with pytest.raises(InputError, match="no test cameras") as refused:
        choose([trial("blind", math.nan, 100)])
    hint = re.search(r"--set '(\w+)\.(\w+)=", str(refused.value))
    assert hint, "the message says what to do"
    section = Recipe.model_fields[hint[1]].annotation
    assert hint[2] in section.model_fields, "the key that the message names is one of a recipe"  # type: ignore[union-attr]
    table = tune_table([large, good, Trial("broken", error="it broke")], good).splitlines()
    assert "<- chosen" in table[2]
    assert "| good" in table[2]
    assert "failed: it broke" in table[-1]


def command(out: Path, budget: str, *more: str) -> list[str]:
    sets = [item for setting in TINY for item in ("--set", setting)]
    return [
        "tune",
        "--source",
        WORLD,
        "--out",
        str(out),
        "--budget",
        budget,
        "--method",
        "s2gs-edge",
        "--frames",
        "3",
        "--quiet",
        *sets,
        *more,
    ]


def test_a_pilot_writes_a_recipe_that_runs_inside_the_budget(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    encode(tmp_path / "choosing", "--frames", "1", method="dense", data__split="tuning")
    given = ("--first-frame", str(tmp_path / "choosing"))
    assert run_command(command(tmp_path / "pilot", "size=600B", *given)) == 0
    out = capsys.readouterr().out
    (test_camera,) = open_source(WORLD).info.test.ids
    cells = read_table(tmp_path / "pilot").cells.values()
    assert {name for cell in cells for name in cell["frames"][0]["psnr"]}.isdisjoint({test_camera}), "it has no say"
    assert "| s2gs-edge+budget " in out
    assert out.count("<- chosen") == 1
    tuned = load_recipe(tmp_path / "pilot" / "tuned.yaml").recipe
    assert (tuned.frames, tuned.data.split) == (None, "reporting"), "the run itself trains on all training cameras"
    assert len(read_sweep_data(tmp_path / "pilot").groups) == 4, "a pilot can be reported, its frame 0 was given"
    assert re.search(r"\| s2gs-edge\+budget +\| +2/2 ", out), "the controller keeps both frames inside"
    program, *said = shlex.split(out.rpartition("next: ")[2])
    assert program == "gsstream"
    run_it = [*said, "--frames", "3", "--quiet", "--no-pictures", "--first-frame"]
    assert run_command([*run_it, str(tmp_path / "choosing")]) == 0
    assert f"test cameras: {test_camera} (reporting split" in (tmp_path / "pilot" / "run" / "summary.txt").read_text()
    assert all(sum(line["bytes"].values()) <= 600 for line in metrics(tmp_path / "pilot" / "run")[1:])
    # Nothing fits: said so, with the nearest; the pilot's other candidates are there already.
    (tmp_path / "pilot" / "tuned.yaml").unlink()
    assert run_command(command(tmp_path / "pilot", "time=1ms", *given)) == 1
    err = capsys.readouterr().err
    assert "nothing fits time=0.001 (seconds, bytes): nearest is " in err
    assert not (tmp_path / "pilot" / "tuned.yaml").exists()
    encode(tmp_path / "other", "--frames", "1", "--set", "seed=5", method="dense", data__split="tuning")
    assert run_command(command(tmp_path / "pilot", "time=1ms", "--first-frame", str(tmp_path / "other"))) == 2
    assert "from another frame 0" in capsys.readouterr().err


def test_nonsense_is_refused_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for budget, problem in [("size=3kb", "no unit 'kb'"), ("speed=3s", "unknown key 'speed'")]:
        assert run_command(command(tmp_path / "no", budget)) == 2
        assert problem in capsys.readouterr().err
    assert run_command([*command(tmp_path / "no", "size=3KB"), "--method", "s2gz"]) == 2
    assert "no method named 's2gz'" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


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
    sets = ("structure.resolution=1024", "first_frame.max_points=200", "first_frame.points=recording")
    sets += ("first_frame.max_iterations=200",)
    command = [
        "search",
        "--source",
        TINY_WORLD,
        "--method",
        "dense",
        "--out",
        str(tmp_path),
        "--workers",
        "1",
        "--try",
        "first_frame.max_iterations=0,40",
        *(word for s in sets for word in ("--set", s)),
    ]
    assert run_command(command) == 0
    said = capsys.readouterr().out
    assert "first_frame.max_iterations: 200 -> " in said
    cells = read_table(tmp_path).cells.values()
    assert {cell["axes"]["first_frame.max_iterations"] for cell in cells} == {200, 0, 40}
    names = {name for cell in cells for name in cell["frames"][0]["psnr"]}
    assert names.isdisjoint(open_source(TINY_WORLD).info.test.ids)
    best = max(cells, key=lambda cell: sum(cell["frames"][0]["psnr"].values()))["axes"]["first_frame.max_iterations"]
    recipe = load_recipe(tmp_path / "found.yaml").recipe
    assert (recipe.frames, recipe.data.split) == (None, "reporting")
    assert best in (recipe.first_frame.max_iterations, 200)
    made = len(cells)
    assert run_command(command) == 0
    assert len(read_table(tmp_path).cells) == made, "the same command keeps what is there"
    run = [
        "run",
        "--source",
        TINY_WORLD,
        "--recipe",
        str(tmp_path / "found.yaml"),
        "--out",
        str(tmp_path / "run"),
        "--set",
        "first_frame.max_iterations=2",
        "--frames",
        "1",
        "--quiet",
        "--no-pictures",
    ]
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
