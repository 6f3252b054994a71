"""Values that a recipe leaves to the scene: nothing runs while one of them is open."""

from __future__ import annotations

from gsstream.core.errors import RecipeError
from gsstream.engine.assembly.assemble import Assembly


def refuse_pending(parts: Assembly) -> None:
    """Raise RecipeError while something is still ``auto``: only a run chooses."""
    if parts.pending:
        keys = ", ".join(".".join(path) for path in parts.pending)
        raise RecipeError(
            f"{keys}: 'auto' is chosen by 'gsstream run' and by sweeps, from the recording; give a value here "
            "(recipe.yaml beside a stream has those of its run)"
        )
