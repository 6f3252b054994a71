"""A mistyped key is refused by its full path, and the nearest valid key is offered, wherever in a recipe it stands."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from gsstream.core.errors import RecipeError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.slots import SLOTS
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import ComponentRef, Recipe

CATALOG = load_catalog()


def keys(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """(path, names beside it) of every key of a model."""
    for name, field in model.model_fields.items():
        yield (*path, name), list(model.model_fields)
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel) and inner is not ComponentRef:
            yield from keys(inner, (*path, name))


def part_keys() -> Iterator[tuple[str, str, tuple[str, ...], list[str]]]:
    """(slot, part, path, names beside it) of every setting of every part that is installed and works here."""
    for slot in SLOTS:
        if slot == "renderer":
            continue
        for name in CATALOG.names(slot):
            for path, beside in keys(CATALOG.resolve(slot, name).Config):
                yield slot, name, path, beside


RECIPE_KEYS = list(keys(Recipe))
PART_KEYS = list(part_keys())


@st.composite
def typos(draw: st.DrawFn, word: str, beside: list[str]) -> str:
    """One slip of the finger in a word of at least four letters."""
    assume(len(word) >= 4)
    place = draw(st.integers(0, len(word) - 2))
    letter = draw(st.sampled_from("abcdefghijklmnopqrstuvwxyz_"))
    slips = {
        "left out": word[:place] + word[place + 1 :],
        "swapped": word[:place] + word[place + 1] + word[place] + word[place + 2 :],
        "doubled": word[:place] + word[place] + word[place:],
        "other": word[:place] + letter + word[place + 1 :],
        "more": word[:place] + letter + word[place:],
    }
    slip = slips[draw(st.sampled_from(sorted(slips)))]
    assume(slip not in beside and slip != "base" and "." not in slip)
    return slip


def offered(message: str, typo: str, meant: str, beside: list[str]) -> None:
    """The key that is offered is the one that was meant, or another that is just as near."""
    offer = message.rpartition("did you mean '")[2].removesuffix("'?")
    assert offer in beside, f"{message}: offers no valid key"

    def nearness(key: str) -> float:
        return difflib.SequenceMatcher(None, typo, key).ratio()

    other = max(nearness(offer), difflib.SequenceMatcher(None, offer, typo).ratio())
    assert offer == meant or other >= nearness(meant) - 1e-9, f"{message}: {meant!r} is nearer"


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_keys_of_the_recipe(data: st.DataObject, file: Path) -> None:
    path, beside = data.draw(st.sampled_from(RECIPE_KEYS))
    typo = data.draw(typos(path[-1], beside))
    wrong = (*path[:-1], typo)
    indents = [f"{'  ' * depth}{key}:" for depth, key in enumerate(wrong)]
    file.write_text("\n".join(indents) + " 1\n")
    with pytest.raises(RecipeError) as caught:
        resolve_recipe("dense", CATALOG.recipe_path, [file])
    message = str(caught.value)
    assert message.startswith(f"{file}:{len(wrong)}:{2 * len(path) - 1}: unknown key '{'.'.join(wrong)}'")
    offered(message, typo, path[-1], beside)
    with pytest.raises(RecipeError) as caught:
        resolve_recipe("dense", CATALOG.recipe_path, (), [("--set", f"{'.'.join(wrong)}=1")])
    offered(str(caught.value), typo, path[-1], beside)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_settings_of_parts(data: st.DataObject) -> None:
    slot, part, path, beside = data.draw(st.sampled_from(PART_KEYS))
    typo = data.draw(typos(path[-1], beside))
    # A typo may be a key of the reference to the part itself.
    assume(len(path) > 1 or typo not in ComponentRef.model_fields)
    wrong = ".".join((*path[:-1], typo))
    texts = ["renderer=reference", f"{slot}={part}", f"{slot}.{wrong}=1"]
    resolved = resolve_recipe("dense", CATALOG.recipe_path, (), [("--set", text) for text in texts])
    with pytest.raises(RecipeError) as caught:
        assemble(resolved, CATALOG)
    message = str(caught.value)
    assert f"--set {slot}.{wrong}=1: unknown key '{slot}.params.{wrong}'" in message
    offered(message, typo, path[-1], beside)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("typos") / "recipe.yaml"


def test_there_is_something_to_mistype() -> None:
    assert len(RECIPE_KEYS) > 55
    assert len(PART_KEYS) > 30
