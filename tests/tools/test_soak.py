"""The soak job: its cases repeat, cover what there is, and what goes wrong is found, recorded and can be run again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.discovery.catalog import load_catalog
from tools.soak import __main__ as soak
from tools.soak import drive
from tools.soak.cases import SOMETIMES, Case, draw_case, draw_value
from tools.soak.drive import run_case
from tools.soak.summary import summarise

CATALOG = load_catalog()
SMALL = (("frames", 3), ("first_frame.max_iterations", 5), ("first_frame.max_points", 100), ("stream.epochs", 1))


def small_case(*settings: tuple[str, Any], method: str = "dense") -> Case:
    return Case(0, 0, "synthetic:frames=3&views=2&width=24&height=16&supersample=1", method, (*SMALL, *settings))


def test_cases_repeat_and_cover_what_there_is() -> None:
    cases = [draw_case(5, index, CATALOG) for index in range(300)]
    assert draw_case(5, 17, CATALOG) == cases[17] != draw_case(6, 17, CATALOG)
    assert len({case.command for case in cases}) == 300
    assert {case.method for case in cases} == set(CATALOG.names("method"))
    keys = {key for case in cases for key, _ in case.settings}
    assert set(SOMETIMES) <= keys
    for slot, name in [("gate", "binary-ste"), ("propagation", "ft-pruning"), ("update", "latent")]:
        assert any((f"{slot}.name", name) in case.settings for case in cases)
    assert {"gate.params.levels", "structure.params.root_exponent", "streaming_method.params.gate.l0"} <= keys


def test_drawn_settings_lie_in_their_ranges() -> None:
    """A part's settings are drawn from what its Config declares, so none is refused for its range."""
    rng = np.random.default_rng(0)
    for kind, name in [
        ("gate", "gumbel-sigmoid"),
        ("regularizer", "expected-sparsity"),
        ("confidence", "view-gradient"),
    ]:
        config = CATALOG.resolve(kind, name).Config
        for key, info in config.model_fields.items():
            for _ in range(50):
                value = draw_value(info, info.default, rng)
                assert value is None or getattr(config(**{key: value}), key) == value


def test_some_seconds_of_it(tmp_path: Path) -> None:
    soak.main(["--minutes", "0.1", "--seed", "3", "--out", str(tmp_path)])
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["failures"] == []
    assert summary["ok"] == summary["recipes"] > 0
    assert summary["frames"] >= 2 * summary["ok"]
    first = soak.read_runs(tmp_path)[0]
    assert first["rss_mb"] > 50
    assert first["command"] == draw_case(3, 0, CATALOG).command


#: Python runs this before anything else; the folder of the program is not yet among those that modules come from.
STANDSTILL = """
import sys, time
sys.path.insert(0, {root!r})
from tools.soak import drive
drive.run_case = lambda *case: time.sleep(600)
"""


def test_a_hang_is_recorded_and_the_next_case_gets_its_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hang is a real one in the working process: a stack that runs on while it is written shows nothing certain."""
    (tmp_path / "sitecustomize.py").write_text(STANDSTILL.format(root=str(soak.ROOT)), encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    out = tmp_path / "out"
    soak.main(["--minutes", "0.06", "--seed", "3", "--limit", "0.2", "--out", str(out)])
    runs = soak.read_runs(out)
    assert {run["outcome"]["status"] for run in runs} == {"hung"}
    problem = runs[0]["outcome"]["problem"]
    assert "Timeout" in problem, problem
    assert "sitecustomize.py" in problem, "the record shows where it hung"
    assert "in work" in problem, "the record shows what called"
    assert [run["index"] for run in runs] == list(range(len(runs)))


def test_a_player_that_sees_something_else_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_case(small_case(), CATALOG, tmp_path).status == "ok"

    def spoil(*args: Any, **kwargs: Any) -> Any:
        result = encode(*args, **kwargs)
        data = (tmp_path / "stream.gss").read_bytes()
        (tmp_path / "stream.gss").write_bytes(data[:-150])
        return result

    encode = drive.run
    monkeypatch.setattr(drive, "run", spoil)
    (tmp_path / "stream.gss").unlink()
    (tmp_path / "metrics.jsonl").unlink()
    outcome = run_case(small_case(), CATALOG, tmp_path)
    assert outcome.status == "failed"
    assert "the player finds" in outcome.problem


def test_one_other_bit_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the encoder holds after a frame is changed in one bit; the stream stays as it is."""

    def once(state: Any) -> str:
        if not seen and state.frame == 2:
            state.gaussians.means.view(np.uint32)[0, 0] ^= 1
            seen.append(state.frame)
        return digest(state)

    seen: list[int] = []
    digest = drive.digest
    monkeypatch.setattr(drive, "digest", once)
    outcome = run_case(small_case(), CATALOG, tmp_path)
    assert outcome.problem.startswith("Fault: frame 2, played in order, differs")


def test_a_recipe_that_contradicts_itself_is_refused_and_no_failure(tmp_path: Path) -> None:
    outcome = run_case(small_case(("gate.params.levels", 7)), CATALOG, tmp_path)
    assert (outcome.status, outcome.frames) == ("refused", 0)
    assert "levels" in outcome.problem


def record(status: str, size: float, process: int = 1) -> dict[str, Any]:
    outcome = {"status": status, "problem": "x\ny", "frames": 2, "kinds": {"key": 1, "delta": 1}, "gaussians": 5}
    where = {"index": 0, "process": process, "method": "m", "command": "c"}
    return {**where, "outcome": outcome, "rss_mb": size, "time": 0}


def test_the_summary_is_clean_only_without_failures_and_with_flat_memory() -> None:
    flat = [record("ok", 100)] * 9
    assert summarise(flat)["clean"]
    assert not summarise([*flat, record("failed", 100)])["clean"]
    assert not summarise([record("ok", 100 + 2 * i) for i in range(9)])["clean"]
    mixed = summarise([*flat, record("hung", 100), *flat[:3]])
    assert (mixed["longest_clean"]["cases"], mixed["failures"]) == (9, [("x", 1)])
