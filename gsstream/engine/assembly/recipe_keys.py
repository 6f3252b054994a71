"""Which keys of a recipe a method would not read: a run that changes them is refused, so that none is ignored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from gsstream.core.kinds import METHOD_SLOTS
from gsstream.method.base import StreamingMethod
from gsstream.recipe.document import KeyPath
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import Recipe

#: Sections that, beside the slots of parts, only a method made of parts reads.
PART_SECTIONS = ("stream", "codec", "budget")
#: Keys of those sections that the engine itself reads for every method, also to make frame 0.
SESSION_KEYS = ("codec.key_rd_lambda", "codec.first_layer", "budget.memory", "stream.on_error")
#: Slots and settings that only the optimisation of a residual reads.
RESIDUAL_KEYS = (
    "confidence", "propagation", "gate", "regularizer", "stream.epochs", "stream.lr_final_factor",
    "stream.active_threshold", "stream.rd_lambda", "stream.progressive",
)  # fmt: skip


def unused_key_messages(recipe: Recipe, parts: Mapping[str, Any], resolved: ResolvedRecipe) -> list[str]:
    """Return messages about keys that the method does not read: one each, or one line where most come from its base.

    Arguments:
        recipe: the recipe with the settings of all parts written out.
        parts: slot -> part, that of the streaming method included.
        resolved: the recipe as it was written, which knows where its values come from.
    """
    paths = list(unused_keys(recipe, parts["streaming_method"], parts))
    name, base = resolved.recipe.streaming_method.name, resolved.recipe.method
    from_base = [path for path in paths if resolved.near(path).label == f"method {base}"]
    if len(from_base) > 2:
        where = resolved.near(("streaming_method", "name")).where
        some = ", ".join(".".join(path) for path in from_base[:3])
        return [
            f"{where}: the streaming_method {name!r} reads none of {len(from_base)} settings that the method {base!r} "
            f"brings ({some}, ...); put it in place of another method: --method dense --set streaming_method={name}"
        ]
    hint = f"the streaming_method {name!r} does not read it; its own settings: gsstream plugins streaming_method/{name}"
    if name == "parts":  # which reads every key, but for those of a residual that is never sent
        hint = f"nothing reads it, because the update {resolved.recipe.update.name!r} sends no residual"
    return [f"{resolved.near(path).where}: {'.'.join(path)}: {hint}" for path in paths]


def unused_keys(recipe: Recipe, method: StreamingMethod[Any], parts: Mapping[str, Any]) -> Iterator[KeyPath]:
    """Yield the paths of keys that differ from their default though the method does not read them."""
    default = Recipe()
    # An update rule without codes sends no residual in any frame: then nothing asks which gates it would open.
    idle = "update" in parts and method.reads("update") and not parts["update"].codes()

    def is_read(key: str) -> bool:
        return method.reads(key) and not (idle and key in RESIDUAL_KEYS)

    for slot in METHOD_SLOTS:
        if slot not in parts or is_read(slot):
            continue
        if getattr(recipe, slot).name != getattr(default, slot).name:
            yield slot, "name"
        elif parts[slot].config != type(parts[slot])().config:
            yield slot, "params"
    for section in PART_SECTIONS:
        now, usual = getattr(recipe, section), getattr(default, section)
        for key in type(now).model_fields:
            path = f"{section}.{key}"
            if getattr(now, key) != getattr(usual, key) and path not in SESSION_KEYS and not is_read(path):
                yield section, key
