"""What ``gsstream compare`` runs: a sweep with one variant for each method, which all take over one frame 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsstream.core.errors import InputError, RecipeError
from gsstream.discovery.catalog import Catalog
from gsstream.input.recordings.options import SplitName
from gsstream.recipe.load import resolve_recipe
from gsstream_lab.sweep.config import FirstFrame, Measure, Scene, SweepConfig, Variant

EPOCHS = "stream.epochs"
_WHAT = "Methods on one recording from one frame 0, every method at"


def own_settings(
    methods: Sequence[str], scene: Scene, seeds: Sequence[int] = (0,), split: SplitName = "reporting"
) -> SweepConfig:
    """Return the sweep in which every method keeps the settings of its recipe."""
    files = {method for method in methods if method.endswith((".yaml", ".yml"))}
    variants = [
        Variant(name=Path(method).stem, recipe=str(Path(method).resolve()))
        if method in files
        else Variant(name=method, method=method)
        for method in methods
    ]
    names = [variant.name for variant in variants]
    for name in names:
        if names.count(name) > 1:
            raise RecipeError(f"two methods are called {name!r}; give each once, or rename the recipe file")
    return SweepConfig(
        name="compare",
        description=f"{_WHAT} its own settings.",
        scenes=[scene],
        seeds=list(seeds),
        variants=variants,
        first_frame=FirstFrame(share="scene"),
        split=split,
        measure=Measure(fps=True),
    )


def equal_epochs(config: SweepConfig, epochs: Sequence[int], catalog: Catalog) -> SweepConfig:
    """Return the sweep in which every method makes the same number of passes over the training cameras a frame."""
    read = own_epochs(config, catalog)
    epochs = epochs or [number for number in read.values() if number is not None][:1] or [1]
    without = [name for name, number in read.items() if number is None]
    said = f"; no passes in {', '.join(without)}" if without else ""
    axes = {name: list(epochs) for name, number in read.items() if number is not None}
    return _at(config, axes, f"{', '.join(map(str, epochs))} epochs a frame{said}")


def equal_time(
    config: SweepConfig, seconds: Sequence[float], took: Mapping[str, float], catalog: Catalog
) -> SweepConfig:
    """Return the sweep in which every method makes as many passes as fit into the same processor time.

    The number is that of its own recipe times the ratio of the times, at least 1. What does not depend on passes is
    not taken out, so what a method really took stands in the table.
    """
    read = own_epochs(config, catalog)
    known = {name: number for name, number in read.items() if number is not None and took.get(name, 0) > 0}
    if not seconds and not known:
        raise InputError("--at time: no method that makes passes over the cameras has run; say --seconds")
    seconds = seconds or [took[name] for name in known][:1]
    axes = {
        name: list(dict.fromkeys(max(1, round(number * limit / took[name])) for limit in seconds))
        for name, number in known.items()
    }
    return _at(config, axes, f"about {', '.join(f'{limit:.3g}' for limit in seconds)} processor seconds a frame")


def own_epochs(config: SweepConfig, catalog: Catalog) -> dict[str, int | None]:
    """Return name -> passes a frame by its own recipe; None for a method that makes none."""
    out: dict[str, int | None] = {}
    for variant in config.variants:
        files = [Path(name) for name in (variant.recipe, config.scenes[0].recipe) if name]
        recipe = resolve_recipe(variant.method, catalog.recipe_path, files).recipe
        streaming_method = catalog.resolve("streaming_method", recipe.streaming_method.name)
        reads = recipe.streaming_method.name == "parts" or EPOCHS in streaming_method.recipe_keys
        out[variant.name] = recipe.stream.epochs if reads else None
    return out


def _at(config: SweepConfig, axes: Mapping[str, list[int]], what: str) -> SweepConfig:
    variants = [
        variant.model_copy(update={"axes": {EPOCHS: axes[variant.name]}}) if variant.name in axes else variant
        for variant in config.variants
    ]
    return config.model_copy(update={"variants": variants, "description": f"{_WHAT} {what}."})
