"""Layers -> one recipe: model defaults <- the method's file <- recipe files <- the command line.

A file may say ``base: NAME`` (a method) or ``base: other.yaml`` (a file beside it) and then only its differences.
``recording:NAME`` in place of a file is a recipe that gsstream ships.
Naming another part in a slot drops the parameters that lower layers gave to the former one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsstream.core.digest import hash_recipe
from gsstream.core.errors import RecipeError
from gsstream.recipe.check import join_problems, keep_known, validate
from gsstream.recipe.document import (
    DEFAULT,
    Empty,
    KeyPath,
    Layer,
    Leaf,
    Origin,
    is_file,
    read_file,
    read_override,
)
from gsstream.recipe.model import Recipe
from gsstream.recipe.shipped import label_of, recipe_file

#: Finds the YAML file of a named method; raises UnknownName or PluginUnavailable.
FindMethod = Callable[[str], Path]


@dataclass(frozen=True, slots=True)
class ResolvedRecipe:
    """A valid recipe and, for every leaf that is not a model default, where its value comes from."""

    recipe: Recipe
    origins: Mapping[KeyPath, Origin]

    def origin(self, path: KeyPath) -> Origin:
        """Return the origin of the leaf at ``path``, or of the nearest enclosing key when it was not written."""
        for end in range(len(path), 0, -1):
            if (found := self.origins.get(path[:end])) is not None:
                return found
        return DEFAULT

    def near(self, path: KeyPath) -> Origin:
        """Return the place of a problem at ``path``: of the value written there, below it, or closest around it."""
        for end in range(len(path), 0, -1):
            for written, origin in self.origins.items():
                if written[:end] == path[:end]:
                    return origin
        return DEFAULT


def resolve_recipe(
    method: str | None,
    find_method: FindMethod,
    files: Sequence[Path] = (),
    overrides: Sequence[tuple[str, str]] = (),
    layers: Sequence[Layer] = (),
) -> ResolvedRecipe:
    """Stack the layers and validate the result; every problem found is reported in one error.

    Raises:
        RecipeError: unknown keys (with the nearest valid name), values out of range, contradictions.
        UnknownName, PluginUnavailable: from ``find_method``; UnknownName also for a ``recording:NAME`` of ``files``.
    """
    files = [recipe_file(file) for file in files]
    chain = [layer for file in files[:1] for layer in _file_chain(file, find_method, ())]
    later = [layer for file in files[1:] for layer in _later_file(file, find_method)]
    stated = [layer.leaves[("method",)] for layer in chain if ("method",) in layer.leaves]
    named = stated[-1].value if stated else None
    if stated and not isinstance(named, str):
        raise RecipeError(f"{stated[-1].origin.where}: method: expected a name, got {named!r}")
    if method and named and named != method:
        raise RecipeError(
            f"{stated[-1].origin.where}: {files[0]} belongs to the method {named!r}, but --method says {method!r}: "
            "leave --method out, or change the file's 'base' or 'method'"
        )
    name = method or named or "dense"
    if not any(leaf.origin.label.startswith("method ") for leaf in stated):
        chain = _method_chain(name, find_method, ()) + chain
    chain += later
    for layer in layers:
        if ("method",) in layer.leaves:
            leaf = layer.leaves[("method",)]
            raise RecipeError(
                f"{leaf.origin.where}: method: expected a setting, got a method, which brings a recipe of its own"
            )
    if overrides:
        leaves: dict[KeyPath, Leaf] = {}
        for option, text in overrides:
            path, leaf = read_override(text, option)
            if path == ("method",):
                raise RecipeError(
                    f"{leaf.origin.where}: this would only change the name that a stream bears, not the method; say "
                    f"--method {leaf.value} (now: {name})"
                )
            leaves.pop(path, None)  # a repeated key counts where it was given last
            leaves[path] = leaf
        chain = [*chain, Layer(leaves, shorthand=True)]
    return stack([*chain, *layers])


def _later_file(path: Path, find_method: FindMethod) -> list[Layer]:
    """The layers of a file laid over another: it must not name a method, which would undo the layers below."""
    layers = _file_chain(path, find_method, ())
    for leaf in (layer.leaves[("method",)] for layer in layers if ("method",) in layer.leaves):
        raise RecipeError(
            f"{leaf.origin.where}: {path} belongs to the method {leaf.value!r}, and only the first recipe file may "
            "belong to one: give it first"
        )
    return layers


def load_recipe(path: Path) -> ResolvedRecipe:
    """Read a complete recipe, such as the one saved beside a result; missing keys take the model's defaults."""
    layer = read_file(path)
    if ("base",) in layer.leaves:
        raise RecipeError(f"{layer.leaves[('base',)].origin.where}: a complete recipe has no 'base'")
    return stack([layer])


def stack(layers: Sequence[Layer]) -> ResolvedRecipe:
    """Merge layers, lowest first, check every key and validate the whole. Raises RecipeError with all problems."""
    problems: list[str] = []
    merged: dict[KeyPath, Leaf] = {}
    for layer in layers:
        known = keep_known(layer, problems)
        for path, leaf in known.items():
            if len(path) == 2 and path[1] == "name" and leaf.value != _part_name(merged, path):
                for stale in [p for p in merged if p[:2] == (path[0], "params")]:
                    del merged[stale]
        for path, leaf in known.items():
            if not isinstance(leaf.value, Empty):
                _put(merged, path, leaf)
            elif "params" in path[:-1] and not any(p[: len(path)] == path for p in merged):
                _put(merged, path, Leaf({}, leaf.origin))  # a part's setting may be a mapping without entries
    origins = {path: leaf.origin for path, leaf in merged.items()}
    recipe = validate(Recipe, _nest(merged), ResolvedRecipe(Recipe(), origins).near, prefix=(), problems=problems)
    join_problems(problems)
    assert recipe is not None, "an invalid recipe leaves at least one problem"
    return ResolvedRecipe(recipe, origins)


def recipe_hash(recipe: Recipe) -> str:
    """Return the first 16 hex digits of the SHA-256 of the recipe's values, provenance left out.

    Equal hashes mean equal runs of the same recording. ``StreamMeta.recipe_hash`` is the same number.
    """
    return hash_recipe(recipe.model_dump(mode="json"))


def _method_chain(name: str, find_method: FindMethod, within: tuple[str, ...]) -> list[Layer]:
    path = find_method(name)
    chain = _file_chain(path, find_method, within, label=f"method {name}")
    stamp = Leaf(name, Origin(f"method {name}", str(path)))
    return [*chain, Layer({("method",): stamp})]


def _file_chain(path: Path, find_method: FindMethod, within: tuple[str, ...], label: str | None = None) -> list[Layer]:
    """The layers of a file: those of its base, then its own."""
    layer = read_file(path, label or label_of(path))
    key = str(path.resolve())
    leaves = dict(layer.leaves)
    base = leaves.pop(("base",), None)
    if base is None:
        return [layer]
    if not isinstance(base.value, str):
        raise RecipeError(f"{base.origin.where}: base: expected the name of a method or a file, got {base.value!r}")
    method = re.fullmatch(r"[a-z][a-z0-9_-]*", base.value) is not None
    target = find_method(base.value) if method else recipe_file(base.value, path.parent)
    if not is_file(target):
        raise RecipeError(f"{base.origin.where}: base: there is no file {target}")
    circle = (*within, key, str(target.resolve()))
    if circle[-1] in circle[:-1]:
        raise RecipeError(f"{base.origin.where}: base: goes in a circle: {' -> '.join(circle)}")
    if method:
        below = _method_chain(base.value, find_method, circle[:-1])
    else:
        below = _file_chain(target, find_method, circle[:-1], label)
    return [*below, Layer(leaves, layer.marks)]


def _put(leaves: dict[KeyPath, Leaf], path: KeyPath, leaf: Leaf) -> None:
    """Set a leaf; values above or below that path are removed."""
    for other in [p for p in leaves if p[: len(path)] == path or path[: len(p)] == p]:
        del leaves[other]
    leaves[path] = leaf


def _part_name(merged: Mapping[KeyPath, Leaf], path: KeyPath) -> Any:
    """The part that the layers so far put into the slot ``path[0]``."""
    return merged[path].value if path in merged else Recipe.model_fields[path[0]].default.name


def _nest(leaves: Mapping[KeyPath, Leaf]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, leaf in leaves.items():
        node = tree
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = leaf.value
    return tree
