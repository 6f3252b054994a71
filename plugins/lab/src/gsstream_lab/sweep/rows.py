"""Variants that start from a variant of another sweep's file, so that a row of a table is written down once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsstream.core.errors import RecipeError, UnknownName
from gsstream_lab.sweep.config import SweepConfig, Variant, flat_settings, read_sweep


def with_bases(config: SweepConfig, folder: Path) -> SweepConfig:
    """Replace every ``base`` of a sweep's variants by what it stands for. Raises RecipeError or UnknownName."""
    return config.model_copy(update={"variants": [_resolved(variant, folder, ()) for variant in config.variants]})


def _resolved(variant: Variant, folder: Path, within: tuple[str, ...]) -> Variant:
    """A variant without a base; ``within``: bases that led here."""
    if variant.base is None:
        return variant
    name, _, row = variant.base.partition("#")
    file, row = (folder / name).resolve(), row or variant.name
    path = (*within, f"{file}#{row}")
    if path[-1] in within:
        raise RecipeError(f"variant {variant.name}: base: goes in a circle: {' -> '.join(path)}")
    others = read_sweep(file).variants
    found = next((other for other in others if other.name == row), None)
    if found is None:
        raise UnknownName(f"variant in {file}", row, [other.name for other in others])
    found = _resolved(found, file.parent, path)
    if found.axes:
        raise RecipeError(
            f"variant {variant.name}: base: {variant.base} has axes, so it is more than one recipe; write out the one "
            "that is meant"
        )
    recipe = found.recipe and os.path.relpath(file.parent / found.recipe, folder)
    settings = _laid_over(found.set, variant.set, f"variant {variant.name}: set")
    taken = {"base": None, "method": found.method, "recipe": recipe, "set": settings}
    return variant.model_copy(update={**taken, "disturbed": variant.disturbed or found.disturbed})


def _laid_over(below: Mapping[str, Any], above: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Settings of the base that no setting of the variant touches, then those of the variant."""
    mine = flat_settings(above, where)
    kept = {
        ".".join(path): value
        for path, value in flat_settings(below, where).items()
        if not any(path[: len(own)] == own or own[: len(path)] == path for own in mine)
    }
    return {**kept, **above}
