"""Checks of written keys and values by pydantic models; messages name the place and the nearest valid key."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from gsstream.core.errors import RecipeError, suggest
from gsstream.core.versions import NEWER_RECIPE, version_problem
from gsstream.recipe.document import Empty, KeyPath, Layer, Leaf, Origin
from gsstream.recipe.model import SCHEMA_VERSION, ComponentRef, Recipe

#: Most problems listed at once; a file with more is probably not a recipe.
MAX_PROBLEMS = 30
#: What a renderer brings, which a recipe does not choose.
RENDERERS_OWN = ("loss", "optimiser")

Model = TypeVar("Model", bound=BaseModel)


def join_problems(problems: Sequence[str], what: str = "the recipe") -> None:
    """Raise one RecipeError that lists all problems; do nothing when there are none."""
    if len(problems) == 1:
        raise RecipeError(problems[0])
    if problems:
        raise RecipeError(f"{len(problems)} problems in {what}:\n  " + "\n  ".join(problems))


def keep_known(layer: Layer, problems: list[str]) -> dict[KeyPath, Leaf]:
    """Return the layer's leaves under their full paths; unknown keys go to ``problems``, each once.

    A slot may be given as a bare name (``gate: always-open``); with ``layer.shorthand`` a slot's unknown key is taken
    for one of its part's parameters.
    """
    known: dict[KeyPath, Leaf] = {}
    refused: set[KeyPath] = set()
    for path, leaf in layer.leaves.items():
        if len(problems) >= MAX_PROBLEMS:
            problems.append("and more")
            break
        full, problem, upto = _full_path(path, leaf, layer.shorthand)
        if problem is None:
            known[full] = leaf
        elif path[:upto] not in refused:
            refused.add(path[:upto])
            problems.append(f"{layer.where(path[:upto], leaf)}: {problem}")
    return known


def _full_path(path: KeyPath, leaf: Leaf, shorthand: bool) -> tuple[KeyPath, str | None, int]:
    """(full path, problem or None, number of leading keys the problem is about)."""
    model: type[BaseModel] = Recipe
    for depth, key in enumerate(path):
        name = ".".join(path[: depth + 1])
        if key not in model.model_fields:
            if model is ComponentRef and shorthand:
                return (*path[:depth], "params", *path[depth:]), None, 0
            if model is ComponentRef:
                hint = f"; a part's own settings go under '{'.'.join(path[:depth])}.params'"
                return path, f"unknown key {name!r}{hint}", depth + 1
            if name in RENDERERS_OWN:
                return path, f"unknown key {name!r}: the {name} is part of the renderer, so renderer.name chooses it", 1
            return path, f"unknown key {name!r}{suggest(key, model.model_fields)}", depth + 1
        annotation = model.model_fields[key].annotation
        last = depth == len(path) - 1
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model = annotation
            if last and model is ComponentRef and isinstance(leaf.value, str):
                return (*path, "name"), None, 0
            if last and not isinstance(leaf.value, Empty):
                keys = ", ".join(model.model_fields)
                return path, f"{name!r} is a section with the keys {keys}; got {leaf.value!r}", depth + 1
        elif model is ComponentRef and key == "params":
            if last and not isinstance(leaf.value, Empty):
                return path, f"{name!r} holds the part's settings by name; got {leaf.value!r}", depth + 1
            return path, None, 0
        elif not last or isinstance(leaf.value, Empty):
            return path, f"{name!r} is a single value; got keys below it", depth + 1
    return path, None, 0


def validate(
    model: type[Model],
    values: Mapping[str, Any],
    origin: Callable[[KeyPath], Origin],
    prefix: KeyPath,
    problems: list[str],
) -> Model | None:
    """Validate ``values`` laid over the model's defaults; on failure append one line per problem and return None."""
    if model is Recipe and isinstance(written := values.get("schema_version"), str):
        problem = version_problem("recipe schema", written, SCHEMA_VERSION, NEWER_RECIPE)
        if problem:
            problems.append(f"{origin(('schema_version',)).where}: {problem}")
            return None
        values = {**values, "schema_version": SCHEMA_VERSION}
    try:
        # Strict, so that "3" or true never pass for numbers; through JSON, so that a list may still be a tuple.
        return model.model_validate_json(json.dumps(_with_defaults(model, values)), strict=True)
    except ValidationError as error:
        for item in error.errors(include_url=False):
            path = tuple(str(part) for part in item["loc"])
            full = (*prefix, *path)
            name = ".".join(full)
            if item["type"] == "extra_forbidden":
                text = f"unknown key {name!r}{suggest(path[-1], _fields_at(model, path[:-1]))}"
            elif item["type"] == "missing":
                text = f"{name!r} is missing{_description(model, path)}"
            else:
                reason = item["msg"].removeprefix("Value error, ")
                text = f"{name}: {reason[0].lower()}{reason[1:]}, got {item['input']!r}"
            problems.append(f"{origin(full).where}: {text}")
        return None


def _with_defaults(model: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Lay ``values`` over the model's defaults, section by section, so that a nested section may be given in part."""
    out = dict(values)
    for name, info in model.model_fields.items():
        default, given = info.default, out.get(name)
        if isinstance(default, BaseModel) and isinstance(given, Mapping):
            out[name] = {**default.model_dump(mode="json"), **_with_defaults(type(default), given)}
    return out


def _model_at(model: type[BaseModel], path: KeyPath) -> type[BaseModel] | None:
    current: Any = model
    for key in path:
        field = current.model_fields.get(key) if isinstance(current, type) and issubclass(current, BaseModel) else None
        current = field.annotation if field else None
    return current if isinstance(current, type) and issubclass(current, BaseModel) else None


def _fields_at(model: type[BaseModel], path: KeyPath) -> list[str]:
    found = _model_at(model, path)
    return list(found.model_fields) if found else []


def _description(model: type[BaseModel], path: KeyPath) -> str:
    found = _model_at(model, path[:-1])
    field = found.model_fields.get(path[-1]) if found else None
    return f": {field.description}" if field and field.description else ""
