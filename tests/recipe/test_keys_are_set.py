"""A key of a recipe is set in some YAML of the repository, by a how-to, or by an option: else it is a constant."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import BaseModel

from gsstream.cli.run import run
from gsstream.recipe.document import read_file
from gsstream.recipe.model import ComponentRef, Recipe

ROOT = Path(__file__).parents[2]
#: Most keys that a recipe may have: one more needs a better reason than another default.
MOST = 58
#: Options of ``gsstream run`` and the keys that they set.
OPTIONS = {
    "--method": ("method",), "--scale": ("scale",), "--frames": ("frames",),
    "--budget": ("budget.time", "budget.size", "budget.rate", "budget.memory"),
}  # fmt: skip


def keys(model: type[BaseModel] = Recipe, above: str = "") -> Iterator[str]:
    """Every key with a value of its own; the slot of a part is one key, whatever its part can be told."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind is not ComponentRef:
            yield from keys(kind, f"{above}{name}.")
        else:
            yield f"{above}{name}"


def paths(value: Any, above: str = "") -> Iterator[str]:
    """Dotted paths of a YAML file, every one with all that it ends in."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            path = f"{above}.{key}" if above else str(key)
            parts = path.split(".")
            yield from (".".join(parts[i:]) for i in range(len(parts)))
            yield from paths(inner, path)
    elif isinstance(value, list):
        for inner in value:
            yield from paths(inner)


@pytest.fixture(scope="module")
def written() -> set[str]:
    """What YAML files set."""
    files = [path for folder in ("configs", "gsstream", "plugins") for path in (ROOT / folder).rglob("*.yaml")]
    assert len(files) > 40, "the files were not found"
    leaves = [item for file in files for item in read_file(file).leaves.items()]
    return {found for path, leaf in leaves for found in paths({".".join(path): leaf.value})}


@pytest.fixture(scope="module")
def told() -> str:
    """The text of how-tos."""
    patterns = ("README.md", "docs/howto/*.md", "docs/tutorial/*.md", "plugins/*/README.md")
    pages = [page for pattern in patterns for page in ROOT.glob(pattern)]
    assert len(pages) > 20, "the pages were not found"
    return "\n".join(page.read_text(encoding="utf-8") for page in pages)


def test_every_key_is_set_somewhere(written: set[str], told: str) -> None:
    command = typer.Typer()
    command.command()(run)
    given = {option for parameter in typer.main.get_command(command).params for option in parameter.opts}
    assert set(OPTIONS) <= given, "options of this test that gsstream run does not have"
    by_option = {key for option in OPTIONS.values() for key in option}
    found = {key: [] for key in keys()}
    for key, places in found.items():
        places += ["option"] * (key in by_option) + ["YAML"] * (key in written)
        places += ["how-to"] * bool(re.search(rf"(?<![\w.]){re.escape(key)}=\S", told))
    print("\n".join(f"{key}: {', '.join(places)}" for key, places in found.items()))
    assert [key for key, places in found.items() if not places] == []


def test_keys_are_few() -> None:
    assert len(list(keys())) <= MOST
