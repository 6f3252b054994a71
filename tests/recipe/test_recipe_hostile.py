"""Recipes that nobody would write are refused at once; keys of a recipe that nobody sets are none."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import BaseModel

from gsstream.cli.run import run
from gsstream.core.errors import RecipeError, UnknownName
from gsstream.discovery.catalog import load_catalog
from gsstream.recipe.document import read_file
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import ComponentRef, Recipe

MANY_DIGITS = "1" * 5000
#: What a value may pretend to be. Nothing of it is built, let alone run.
VALUES = (
    MANY_DIGITS, "0x" + "f" * 5000, "1" * 30, "!!int abc", "!!float abc", "!!timestamp x", "!!timestamp 2020-99-99",
    "2020-99-99", "!!bool maybe", "!foo bar", "!!python/name:os.system", "!!binary '***'", "!!omap [a: 1]", "1e999",
    "[" * 5000, "{a: " * 5000,
)  # fmt: skip
#: Whole files.
FILES = {
    "tag directive": b"%TAG ! tag:x,2000:\n---\nseed: !a 1", "half a tag directive": b"%TAG\n---\nseed: 1",
    "a base of 5000 letters": b"base: " + b"x" * 5000, "a path of 6000 letters": b"base: " + b"x/" * 3000 + b"a.yaml",
    "a base with a NUL": b'base: "a\\0b.yaml"', "a folder as its base": b"base: ./", "no UTF-8": b"\xff\xfe\x00",
    "a list of 6 MB": b"data: [" + b"1," * 3_000_000 + b"]", "a key that is a number": b"!!int abc: 1",
    "a list of 190 KB": b"data: {test_cameras: [" + b"1," * 95_000 + b"]}",
    "a list of 190 KB, line by line": b"frames:\n" + b"- 1\n" * 47_000, "a line of dashes": b"a: \n " + b"- " * 90_000,
    "a line of colons": b"a" + b": a" * 60_000, "a line of question marks": b"? " * 90_000,
    "a line of tags": b"a: " + b"!a " * 60_000, "a line of anchors": b"a: " + b"&a " * 60_000,
    "a word of 190 KB": b"method: " + b"x" * 190_000, "a text of 190 KB": b'method: "' + b"\\x41" * 47_000 + b'"',
    "a folded text": b"method: >\n" + b"  a b\n" * 30_000, "lines without end": b"\n" * 190_000,
    "twenty thousand keys": "\n".join(f"key{i}: 1" for i in range(20_000)).encode(),
}  # fmt: skip


def refused(files: list[Path], sets: list[tuple[str, str]]) -> str:
    with pytest.raises((RecipeError, UnknownName)) as caught:
        resolve_recipe(None, load_catalog().recipe_path, files, sets)
    return str(caught.value)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: value[:20])
def test_values(value: str, tmp_path: Path) -> None:
    said = refused([], [("--set", f"seed={value}")])
    assert said.startswith("--set seed=")
    (tmp_path / "recipe.yaml").write_text(f"seed: {value}")
    assert str(tmp_path / "recipe.yaml") in refused([tmp_path / "recipe.yaml"], [])


@pytest.mark.parametrize("name", FILES)
def test_files(name: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_bytes(FILES[name])
    assert len(refused([path], [])) < 7000


@pytest.mark.parametrize("path", ["/dev/zero", "a\0b", "x" * 5000, "."], ids=lambda path: path[:10])
def test_paths(path: str) -> None:
    assert "recipe" in refused([Path(path)], [])


def test_a_name_alone_changes_no_method() -> None:
    """It would label a stream of one method with the name of another."""
    said = refused([], [("--set", "method=hold")])
    assert "say --method hold" in said


ROOT = Path(__file__).parents[2]
#: Most keys that a recipe may have: one more needs a better reason than another default.
MOST = 55
#: Options of ``gsstream run`` and the keys that they set.
OPTIONS = {
    "--method": ("method",),
    "--scale": ("scale",),
    "--frames": ("frames",),
    "--budget": ("budget.time", "budget.size", "budget.rate", "budget.memory"),
}


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
