"""Recipes that nobody would write: each is refused in one sentence, at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsstream.core.errors import RecipeError, UnknownName
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe

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
