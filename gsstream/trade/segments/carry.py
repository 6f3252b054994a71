"""Recipes of the step from one key frame to the next: the method's own, or one with every gate open."""

from __future__ import annotations

from typing import Any

from gsstream.method.base import StreamingMethod
from gsstream.recipe.budget import Budget
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import Codec, GateTraining, Recipe, Stream

#: Slots that decide what is worth sending, and how. The structure stays: it groups the Gaussians for what follows.
SENDING = ("confidence", "propagation", "gate", "regularizer", "update")


def leap_recipe(resolved: ResolvedRecipe, epochs: int, method: StreamingMethod[Any]) -> ResolvedRecipe:
    """Return a method's own recipe with the epochs of a leap.

    Arguments:
        resolved: recipe of the run.
        epochs: passes over the training cameras.
        method: one that does not read epochs keeps its recipe.
    """
    if not method.reads("stream.epochs"):
        return resolved
    stream = resolved.recipe.stream.model_copy(update={"epochs": epochs})
    return ResolvedRecipe(resolved.recipe.model_copy(update={"stream": stream}), resolved.origins)


def open_leap_recipe(resolved: ResolvedRecipe, epochs: int) -> ResolvedRecipe:
    """Return a recipe of parts with every gate open, every attribute free and no limit on bytes or time.

    The delta of a leap is never sent: the key packet that follows holds the whole scene, whatever changed. So few open
    gates and coarse latents save nothing here, and lose quality (docs/results/segments.md has what it costs).
    """
    plain = Recipe()
    changed: dict[str, Any] = {slot: getattr(plain, slot) for slot in SENDING}
    changed |= {
        "stream": Stream(epochs=epochs, on_error=resolved.recipe.stream.on_error),
        "gate_training": GateTraining(),
        "codec": Codec(),
        "budget": Budget(memory=resolved.recipe.budget.memory),
    }
    origins = {path: origin for path, origin in resolved.origins.items() if path[0] not in changed}
    return ResolvedRecipe(resolved.recipe.model_copy(update=changed), origins)
