"""What ``gsstream compare`` runs: a sweep with one variant for each method, which all take over one frame 0."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsstream.core.errors import RecipeError
from gsstream.evaluation.records import mean
from gsstream.input.recordings.options import SplitName
from gsstream.plugins.catalog import Catalog
from gsstream.recipe.load import resolve_recipe
from gsstream_lab.report.groups import SweepData
from gsstream_lab.sweep.config import FirstFrame, Measure, Scene, SweepConfig, Variant

At = Literal["own", "epochs", "time"]
EPOCHS = "stream.epochs"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is compared.

    Arguments:
        methods: names, or recipe files; frame 0 is made by the recipe of the first.
        source: the recording, as for ``--source``.
        recipe: a file with what the recording needs in a recipe, or None.
        frames, scale: of the recording; None: all, and as it is.
        seeds: of every random stream.
        settings: recipe keys of all methods.
        split: which cameras judge.
    """

    methods: tuple[str, ...]
    source: str
    recipe: Path | None = None
    frames: int | None = None
    scale: float | None = None
    seeds: tuple[int, ...] = (0,)
    settings: Mapping[str, Any] = field(default_factory=dict)
    split: SplitName = "reporting"


def own(wanted: Wanted) -> SweepConfig:
    """Return the sweep in which every method keeps the settings of its recipe."""
    return _sweep(wanted, "every method at its own settings", {})


def equal_epochs(wanted: Wanted, epochs: Sequence[int], catalog: Catalog) -> SweepConfig:
    """Return the sweep in which every method makes the same number of passes."""
    read = own_epochs(wanted, catalog)
    axes = {name: list(epochs) for name, number in read.items() if number is not None}
    without = [name for name, number in read.items() if number is None]
    said = f"; no passes in {', '.join(without)}" if without else ""
    return _sweep(wanted, f"every method at {_listed(epochs)} epochs a frame{said}", axes)


def equal_time(wanted: Wanted, seconds: Sequence[float], measured: SweepData, catalog: Catalog) -> SweepConfig:
    """Return the sweep in which every method makes as many passes as fit into the same processor time.

    The number is that of its own recipe times the ratio of the times, at least 1. What does not depend on passes is
    not taken out, so what a method really took stands in the table.
    """
    axes: dict[str, list[int]] = {}
    for name, number in own_epochs(wanted, catalog).items():
        took = own_seconds(measured, name)
        if number is not None and took > 0:
            axes[name] = list(dict.fromkeys(max(1, round(number * limit / took)) for limit in seconds))
    said = _listed([f"{limit:.3g}" for limit in seconds])
    return _sweep(wanted, f"every method at about {said} processor seconds a frame", axes)


def own_seconds(measured: SweepData, name: str) -> float:
    """Return the processor seconds a frame of a method at its own settings; nan when it did not run."""
    return mean(group.mean("cpu_seconds") for group in measured.groups if group.variant == name and not group.axes)


def own_epochs(wanted: Wanted, catalog: Catalog) -> dict[str, int | None]:
    """Return name -> passes a frame by its own recipe; None for a method that makes none."""
    out: dict[str, int | None] = {}
    for variant in _variants(wanted, {}):
        files = [Path(name) for name in (variant.recipe, wanted.recipe) if name]
        recipe = resolve_recipe(variant.method, catalog.recipe_path, files).recipe
        streaming_method = catalog.resolve("streaming_method", recipe.streaming_method.name)
        reads = recipe.streaming_method.name == "parts" or EPOCHS in streaming_method.recipe_keys
        out[variant.name] = recipe.stream.epochs if reads else None
    return out


def scene_name(source: str) -> str:
    """Return the name of a recording in tables: the last part of its URI, or the name of its source."""
    scheme, _, rest = source.partition(":")
    last = Path(rest or scheme).name if "=" not in rest else scheme
    return re.sub(r"[^\w.+-]", "-", last, flags=re.ASCII).lstrip("_.+-") or "recording"


def _sweep(wanted: Wanted, what: str, axes: Mapping[str, Sequence[int]]) -> SweepConfig:
    scene = Scene(
        name=scene_name(wanted.source),
        uri=wanted.source,
        recipe=None if wanted.recipe is None else str(wanted.recipe.resolve()),
        frames=wanted.frames,
        scale=wanted.scale,
    )
    return SweepConfig(
        name="compare", description=f"Methods on one recording from one frame 0, {what}.", scenes=[scene],
        seeds=list(wanted.seeds), variants=_variants(wanted, axes), set=dict(wanted.settings),
        first_frame=FirstFrame(share="scene"), split=wanted.split, measure=Measure(fps=True),
    )  # fmt: skip


def _variants(wanted: Wanted, axes: Mapping[str, Sequence[int]]) -> list[Variant]:
    out: list[Variant] = []
    for method in wanted.methods:
        is_file = method.endswith((".yaml", ".yml"))
        name = Path(method).stem if is_file else method
        if any(name == other.name for other in out):
            raise RecipeError(f"two methods are called {name!r}; give each once, or rename the recipe file")
        mine = {EPOCHS: list(axes[name])} if name in axes else {}
        out.append(
            Variant(name=name, recipe=str(Path(method).resolve()), axes=mine) if is_file
            else Variant(name=name, method=method, axes=mine)
        )  # fmt: skip
    return out


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values))
