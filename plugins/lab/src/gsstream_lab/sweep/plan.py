"""A sweep's file -> its cells: every recipe resolved, every frame 0 that can be shared found. Nothing runs here."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsstream.recipe.document import Layer, Leaf, Origin
from gsstream.recipe.load import FindMethod, ResolvedRecipe, recipe_hash, resolve_recipe
from gsstream.recipe.model import first_frame_settings
from gsstream.recipe.shipped import recipe_file
from gsstream_lab.sweep.config import Axis, Range, Scene, SweepConfig, Variant, flat_settings
from gsstream_lab.sweep.rows import with_bases


@dataclass(frozen=True, slots=True)
class Cell:
    """One run."""

    id: str  # hash of everything that decides the run: equal ids are the same run
    scene: Scene
    variant: str
    axes: Mapping[str, Any]  # recipe key -> value where the cell differs from its variant
    seed: int
    resolved: ResolvedRecipe
    first: str | None  # id of the frame 0 it takes over; None: it makes its own

    @property
    def label(self) -> str:
        """``basketball edge stream.epochs=3 seed 0``."""
        axes = "".join(f" {key}={json.dumps(value)}" for key, value in self.axes.items())
        return f"{self.scene.name} {self.variant}{axes} seed {self.seed}"


@dataclass(frozen=True, slots=True)
class FirstFrameRun:
    """A frame 0 that several cells take over: the recipe of variant ``of``, one frame long."""

    id: str
    scene: Scene
    of: str
    seed: int
    resolved: ResolvedRecipe

    @property
    def label(self) -> str:
        """``basketball frame 0 of s2gs-edge seed 0``."""
        return f"{self.scene.name} frame 0 of {self.of} seed {self.seed}"


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything a sweep will do."""

    config: SweepConfig
    #: All (scene, variant, axes, seed) in the order of the file; two points may be the same run, then they are cells
    #: of the same id.
    points: tuple[Cell, ...]
    firsts: Mapping[str, FirstFrameRun]  # id -> frame 0

    @property
    def cells(self) -> dict[str, Cell]:
        """Id -> cell; each run once."""
        out: dict[str, Cell] = {}
        for point in self.points:
            out.setdefault(point.id, point)
        return out

    def frame_0_of(self, cell: Cell) -> str:
        """Return the name of the variant that made the frame 0 of a cell."""
        return self.firsts[cell.first].of if cell.first else cell.variant


def make_plan(config: SweepConfig, folder: Path, find_method: FindMethod) -> Plan:
    """Resolve every cell of a sweep.

    Raises RecipeError for keys and values that no recipe has, UnknownName for methods and bases of variants.
    """
    config = with_bases(config, folder)
    points: list[Cell] = []
    firsts: dict[str, FirstFrameRun] = {}
    for scene, seed in itertools.product(config.scenes, _all_seeds(config)):
        for variant in config.variants:
            recorded, leader = _recorded(scene, variant, seed), config.leader_of(variant)
            for axes in _points(config, variant, seed):
                resolved = _resolve(
                    config, scene, variant, axes=axes, seed=seed, folder=folder, find_method=find_method
                )
                first = None
                if leader is not None:
                    lead = _resolve(config, scene, leader, axes={}, seed=seed, folder=folder, find_method=find_method)
                    made = _first_frame(config, _recorded(scene, leader, seed), leader, resolved=lead, seed=seed)
                    first = firsts.setdefault(made.id, made).id
                elif config.first_frame.share == "exact":
                    made = _first_frame(config, recorded, variant, resolved=resolved, seed=seed)
                    first = firsts.setdefault(made.id, made).id
                points.append(
                    Cell(
                        id=_cell_id(config, recorded, resolved, first),
                        scene=recorded,
                        variant=variant.name,
                        axes=axes,
                        seed=seed,
                        resolved=resolved,
                        first=first,
                    )
                )
    return Plan(config, tuple(points), firsts)


def _all_seeds(config: SweepConfig) -> list[int]:
    return list(dict.fromkeys([*config.seeds, *(seed for variant in config.variants for seed in variant.base_seeds)]))


def _points(config: SweepConfig, variant: Variant, seed: int) -> Iterator[dict[str, Any]]:
    """The axis values of a variant with this seed: all, the unchanged variant alone, or none."""
    if seed in config.seeds:
        yield from combinations(config, variant)
    elif seed in variant.base_seeds:
        yield {}


def combinations(config: SweepConfig, variant: Variant) -> Iterator[dict[str, Any]]:
    """Return the axis values of a variant's cells, in order."""
    axes: dict[str, Axis] = {**config.axes, **variant.axes}
    if config.search == "random":
        # Drawn from the seed and the variant's name alone: the same file always means the same cells.
        draw = random.Random(f"{config.search_seed} {variant.name}")
        for _ in range(config.samples or 0):
            yield {key: _draw(axis, draw) for key, axis in axes.items()}
        return
    lists = {key: axis for key, axis in axes.items() if isinstance(axis, list)}
    if config.search == "each":
        yield {}
        yield from ({key: value} for key, values in lists.items() for value in values)
        return
    yield from (dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values()))


def _draw(axis: Axis, draw: random.Random) -> Any:
    if isinstance(axis, list):
        return draw.choice(axis)
    value = _uniform(axis, draw)
    return round(value) if axis.integer else value


def _uniform(axis: Range, draw: random.Random) -> float:
    if axis.log:
        # Rounding in exp and log may lead out of the range.
        return min(max(math.exp(draw.uniform(math.log(axis.low), math.log(axis.high))), axis.low), axis.high)
    return draw.uniform(axis.low, axis.high)


def _resolve(
    config: SweepConfig,
    scene: Scene,
    variant: Variant,
    axes: Mapping[str, Any],
    seed: int,
    folder: Path,
    find_method: FindMethod,
) -> ResolvedRecipe:
    """Method <- variant's file <- scene's file <- split <- set of all, scene, variant <- axes <- seed and size."""
    size = {"seed": seed, "scale": scene.scale, "frames": scene.frames}
    written = [
        ("split", {"data.split": config.split}),
        ("set", config.set),
        (f"scene {scene.name}: set", scene.set),
        (f"variant {variant.name}: set", variant.set),
        (f"axes of variant {variant.name}", axes),
        (f"scene {scene.name}", {key: value for key, value in size.items() if value is not None}),
    ]
    files = [recipe_file(name, folder) for name in (variant.recipe, scene.recipe) if name]
    layers = []
    for where, values in written:
        origin = Origin(f"sweep, {where}", f"sweep, {where}")
        leaves = {path: Leaf(value, origin) for path, value in flat_settings(values, where).items()}
        layers.append(Layer(leaves, shorthand=True))
    return resolve_recipe(variant.method, find_method, files, layers=layers)


def _recorded(scene: Scene, variant: Variant, seed: int) -> Scene:
    """The scene with the changes that a variant makes to it."""
    uri = disturbed_uri(scene.uri, variant.disturbed, seed)
    return scene if uri == scene.uri else scene.model_copy(update={"uri": uri})


def disturbed_uri(uri: str, disturbed: str | None, seed: int) -> str:
    """Return the URI of a recording under the disturbances of a variant; None: as it is."""
    return uri if disturbed is None else f"disturbed:{disturbed},seed={seed}:{uri}"


def _first_frame(
    config: SweepConfig, scene: Scene, variant: Variant, resolved: ResolvedRecipe, seed: int
) -> FirstFrameRun:
    seed = seed if config.first_frame.seed is None else config.first_frame.seed
    recipe = resolved.recipe.model_copy(update={"seed": seed, "frames": 1})
    key = _hash([scene.uri, seed, first_frame_settings(recipe)])
    return FirstFrameRun(key, scene, variant.name, seed, ResolvedRecipe(recipe, resolved.origins))


def _cell_id(config: SweepConfig, scene: Scene, resolved: ResolvedRecipe, first: str | None) -> str:
    return _hash([scene.uri, recipe_hash(resolved.recipe), first, config.measure.model_dump(mode="json")])


def _hash(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
