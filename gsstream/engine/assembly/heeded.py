"""Which written keys a whole method would not read: they are refused, not ignored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from gsstream.method.base import StreamingMethod
from gsstream.recipe.document import KeyPath
from gsstream.recipe.model import Recipe

#: Keys that only the five-part path reads.
PART_SLOTS = ("structure", "confidence", "propagation", "gate", "regularizer", "update")
PART_SECTIONS = ("stream", "gate_training", "codec", "insertion", "budget")
#: Of those sections, what the engine itself reads for every method.
SESSION_KEYS = ("codec.fsync", "budget.memory", "stream.on_error")


def unheeded(recipe: Recipe, whole: StreamingMethod[Any], parts: Mapping[str, Any]) -> Iterator[KeyPath]:
    """Paths of keys that differ from their default though the method does not read them.

    Arguments:
        recipe: with every part's parameters written out.
        parts: slot -> live part.
    """
    default = Recipe()
    for slot in PART_SLOTS:
        if slot not in parts or slot in whole.heeds:
            continue
        if getattr(recipe, slot).name != getattr(default, slot).name:
            yield slot, "name"
        elif parts[slot].config != type(parts[slot])().config:
            yield slot, "params"
    for section in PART_SECTIONS:
        now, usual = getattr(recipe, section), getattr(default, section)
        for key in type(now).model_fields:
            if getattr(now, key) != getattr(usual, key) and f"{section}.{key}" not in (*whole.heeds, *SESSION_KEYS):
                yield section, key
