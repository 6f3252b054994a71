"""A search for settings: one key after the other along its values, measured by sweeps on held-out cameras.

Every value is one cell of a sweep (:mod:`gsstream_lab.sweep.drive`), so that a search goes on where it was stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.evaluation.records import mean_of_views
from gsstream.recipe.load import FindMethod, ResolvedRecipe
from gsstream_lab.jobs.base import Executor
from gsstream_lab.sweep.config import FirstFrame, Scene, SweepConfig, Variant
from gsstream_lab.sweep.drive import run_sweep
from gsstream_lab.sweep.plan import make_plan
from gsstream_lab.sweep.table import read_table

#: Least gain of another value, dB: smaller differences cannot be told from noise by a few short fits.
MARGIN = 0.05
#: What is tried where nothing is said: part of the slot "structure" -> key -> values; "" goes for every method.
USUAL: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "": {"first_frame.sh_degree": (0, 1, 2, 3)},
    "octree": {
        "structure.root_exponent": (5, 6, 7, 8, 9),
        "structure.max_levels": (1, 2, 3, 4, 6, 8, 10),
        "structure.log_base": (1.15, 1.3, 1.5, 2.0, 3.0),
    },
}

#: (settings so far, key, values) -> quality of each value, dB, larger is better; nan where it could not be measured.
Score = Callable[[Mapping[str, Any], str, Sequence[Any]], list[float]]


def climb(start: Mapping[str, Any], ladders: Mapping[str, Sequence[Any]], score: Score) -> dict[str, Any]:
    """Return the settings after which no single key has a value that is better by more than ``MARGIN``.

    Raises InputError when no value of a key can be measured.
    """
    best = dict(start)
    while True:
        before = dict(best)
        for key, values in ladders.items():
            found = [value if math.isfinite(value) else -math.inf for value in score(best, key, values)]
            top, now = max(found), found[list(values).index(best[key])]
            if top == -math.inf:
                raise InputError(f"no value of {key} could be evaluated: runs failed, or there is no test camera")
            if top > now + MARGIN:
                best[key] = values[found.index(top)]
        if best == before:
            return best


def usual_ladders(recipe: Any) -> dict[str, Sequence[Any]]:
    """Return what is tried for a method of this recipe where nothing is said."""
    return {**USUAL[""], **USUAL.get(recipe.structure.name, {})}


def value_of(resolved: ResolvedRecipe, key: str) -> Any:
    """Return the value of a key in a recipe that is written out; ``structure.log_base`` means its part's setting."""
    section, *path = key.split(".")
    value: Any = resolved.recipe.model_dump(mode="json").get(section)
    if isinstance(value, dict) and "params" in value and path[:1] != ["params"]:
        value = value["params"]
    for name in path:
        if not isinstance(value, dict) or name not in value:
            raise InputError(f"--try {key}: the recipe has no such value; 'gsstream recipe METHOD --full' lists all")
        value = value[name]
    return value


class SweepScore:
    """Compares values by the mean PSNR of decoded frames, on training cameras that are left out.

    One frame compares the first, more compare those after it.
    """

    def __init__(
        self,
        scene: Scene,
        method: str,
        seed: int,
        out: Path,
        find_method: FindMethod,
        executor: Callable[[], Executor],
        say: Callable[[str], None],
    ) -> None:
        self._scene, self._method, self._seed, self._out = scene, method, seed, out
        self._find, self._executor, self._say = find_method, executor, say

    def config(self, settings: Mapping[str, Any], key: str, values: Sequence[Any]) -> SweepConfig:
        """Return the sweep along one key."""
        others = {name: value for name, value in settings.items() if name != key}
        return SweepConfig(
            name="search",
            description=f"values of {key}",
            scenes=[self._scene],
            seeds=[self._seed],
            variants=[Variant(name=self._method, method=self._method, set=others, axes={key: list(values)})],
            first_frame=FirstFrame(share="own"),
        )

    def __call__(self, settings: Mapping[str, Any], key: str, values: Sequence[Any]) -> list[float]:
        """Run what the table does not hold yet, and return the quality of each value."""
        plan = make_plan(self.config(settings, key, values), Path(), self._find)
        run_sweep(plan, self._out, self._executor(), say=self._say)
        rows = read_table(self._out).cells
        return [quality(rows.get(point.id, {})) for point in plan.points]


def quality(row: Mapping[str, Any]) -> float:
    """Return the mean PSNR of a cell's frames after the first, or of the first where it is alone; nan: not measured."""
    frames = row.get("frames", ())
    scored = frames[1:] or frames
    return mean_of_views(scored, "psnr")
