"""Title of a run in comparisons: its method, and the settings in which the run differs from the method's recipe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from gsstream.core.errors import GsstreamError
from gsstream.core.names import without_places
from gsstream.discovery.catalog import Catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import ComponentRef, Recipe

#: Sections and keys that say what is encoded, where and how fast, and not by what.
NOT_THE_METHOD = {"schema_version", "method", "seed", "renderer", "data", "scale", "frames"}
NOR_THESE = {"stream.on_error"}
#: Changes that are written out; the rest is counted.
SHOWN = 3


def title(recipe: Recipe, catalog: Catalog) -> str:
    """Return a name such as ``s2gs-fast + gate=hard-concrete, stream.epochs=4``.

    It follows from the values alone, not from where they were written, so that a resumed run has the same name. A
    method that was put in by its part, without a recipe of its own, is called by that part.
    """
    try:
        base = resolve_recipe(recipe.method, catalog.recipe_path).recipe
    except GsstreamError:
        return recipe.method
    name, changes = recipe.method, list(_changes(recipe, base, catalog))
    if recipe.streaming_method.name not in (base.streaming_method.name, "parts"):
        name = recipe.streaming_method.name
        changes = [change for change in changes if not change.startswith("streaming_method=")]
    if not changes:
        return name
    more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
    return f"{name} + {', '.join(changes[:SHOWN])}{more}"


def _changes(recipe: Recipe, base: Recipe, catalog: Catalog) -> Iterator[str]:
    """``slot=part`` for other parts, then ``key=value`` for other values, in the order of the recipe."""
    values: list[str] = []
    for section, value in recipe:
        usual = getattr(base, section)
        if section in NOT_THE_METHOD:
            continue
        if not isinstance(value, ComponentRef):
            values += _differences(_plain(value), _plain(usual), section)
        elif value.name != usual.name:
            yield f"{section}={value.name}"
        else:
            written = _merged(_defaults(section, value.name, catalog), usual.params)
            values += _differences(value.params, written, section)
    yield from values


def _defaults(slot: str, part: str, catalog: Catalog) -> dict[str, Any]:
    """The settings of a part at their defaults."""
    try:
        return dict(catalog.resolve(slot, part).Config().model_dump(mode="json"))
    except (GsstreamError, ValueError):
        return {}  # a part with a setting that must be given


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Settings laid over others, section by section."""
    out = dict(below)
    for key, value in above.items():
        under = out.get(key)
        out[key] = _merged(under, value) if isinstance(under, Mapping) and isinstance(value, Mapping) else value
    return out


def _plain(section: Any) -> Any:
    return section.model_dump(mode="json") if hasattr(section, "model_dump") else section


def _differences(value: Any, usual: Any, path: str) -> Iterator[str]:
    if isinstance(value, Mapping) and isinstance(usual, Mapping):
        for key, inner in value.items():
            yield from _differences(inner, usual.get(key), f"{path}.{key}")
    elif path not in NOR_THESE and value != usual and _as_list(value) != _as_list(usual):
        yield f"{path}={_short(value)}"


def _as_list(value: Any) -> Any:
    """Return a tuple as the list that JSON makes of it."""
    return list(value) if isinstance(value, tuple) else value


def _short(value: Any) -> str:
    text = format(value, "g") if isinstance(value, float) else str(without_places(value))
    return text if len(text) <= 24 else f"{text[:21]}..."
