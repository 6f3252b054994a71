"""docs/paper.md: each row of the paper is held by a test, a setting or a sweep, and each of these exists."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from gsstream_lab.sweep.config import read_sweep
from gsstream_lab.sweep.plan import make_plan

from gsstream.discovery.catalog import Catalog, load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.recipe.load import recipe_hash, resolve_recipe

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs" / "paper"
VERDICTS = {"printed", "differs", "cannot"}


def rows() -> list[list[str]]:
    lines = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if line.startswith("| ")]
    return [row for row in cells if row[2] != "verdict"]


ROWS = rows()
HELD = sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[3])})
TESTS = [name for name in HELD if name.startswith("test_")]
SWEEPS = [name for name in HELD if name.endswith(".yaml")]
SETTINGS = [name for name in HELD if name not in {*TESTS, *SWEEPS}]


def test_every_row_has_a_verdict_and_is_held() -> None:
    assert len(ROWS) > 80
    for paper, _, verdict, held in ROWS:
        assert verdict in VERDICTS, paper
        assert held, paper


def test_every_named_test_exists() -> None:
    files = [*ROOT.glob("tests/**/test_*.py"), *ROOT.glob("plugins/*/tests/test_*.py")]
    found = {name for file in files for name in re.findall(r"def (test_\w+)\(", file.read_text(encoding="utf-8"))}
    assert len(TESTS) > 30
    assert not set(TESTS) - found


def test_every_sweep_stands_on_the_page_and_is_planned() -> None:
    recipes = {"full.yaml", "candidates.yaml"}
    assert set(SWEEPS) == {path.name for path in CONFIGS.glob("*.yaml")} - recipes
    for name in SWEEPS:
        config = read_sweep(CONFIGS / name)
        plan = make_plan(config, CONFIGS, load_catalog().recipe_path)
        assert len(plan.points) == len(config.scenes) * len(config.seeds) * len(config.variants), name


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load_catalog()


@pytest.mark.parametrize("setting", SETTINGS)
def test_every_setting_is_accepted_and_changes_the_recipe(setting: str, catalog: Catalog) -> None:
    def hashed(more: Sequence[tuple[str, str]]) -> str:
        return recipe_hash(assemble(resolve_recipe("s2gs-paper", catalog.recipe_path, (), more), catalog).recipe)

    assert hashed([("docs/paper.md", setting)]) != hashed(())
