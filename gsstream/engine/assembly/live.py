"""Parts that a script has made itself, in a recipe: it names them as if they had been chosen by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gsstream.core.errors import InputError
from gsstream.core.kinds import PART_KINDS
from gsstream.core.part import Part
from gsstream.plugins.catalog import Catalog
from gsstream.recipe.document import Origin
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import ComponentRef
from gsstream.spec import ComponentSpec


def with_live(resolved: ResolvedRecipe, live: Mapping[str, Part], catalog: Catalog) -> ResolvedRecipe:
    """Return the recipe with these parts, slot -> part, in place of the ones it names.

    Raises InputError for a part that does not fit its slot.
    """
    refs = {slot: _reference(slot, part, catalog) for slot, part in live.items()}
    origins = {path: origin for path, origin in resolved.origins.items() if path[0] not in refs}
    origins |= {(slot,): Origin("Python", f"Python: {slot}={ref.name}") for slot, ref in refs.items()}
    return replace(resolved, recipe=resolved.recipe.model_copy(update=refs), origins=origins)


def _reference(slot: str, part: Part, catalog: Catalog) -> ComponentRef:
    """The name and settings of a live part; one that no plugin declares is called ``module:Class``."""
    contract: type[Any] = PART_KINDS[slot].contract_class()
    if not isinstance(part, contract):
        raise InputError(f"{slot}: expected a live {contract.__name__} or the name of one, got {part!r}")
    name = target = f"{type(part).__module__}:{type(part).__qualname__}"
    for (kind, known), entry in catalog.entries.items():
        if kind == slot and isinstance(entry.spec, ComponentSpec) and entry.spec.target == target:
            name = known
    return ComponentRef(name=name, params=part.config.model_dump(mode="json"))
