"""Assemblies whose structure is a test's own and leaves settings to the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gsstream.core.part import Part
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe


def asking(structure: type[Part], **params: Any) -> Assembly:
    """The dense method on a structure of which some ``params`` say ``auto``."""
    parts = assemble(resolve_recipe("dense", load_catalog().recipe_path).recipe, load_catalog())
    given = {key: value for key, value in params.items() if value != "auto"}
    pending = tuple(("structure", "params", key) for key in structure.auto_rules if params.get(key) == "auto")
    ref = parts.recipe.structure.model_copy(update={"params": params})
    recipe = parts.recipe.model_copy(update={"structure": ref})
    changed: dict[str, Any] = {"structure": structure(structure.Config(**given)), "recipe": recipe, "pending": pending}
    return replace(parts, **changed)
