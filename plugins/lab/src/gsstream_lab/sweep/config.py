"""A sweep described as data: which recipes on which scenes with which seeds. No torch here: ``--dry-run`` is quick."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from gsstream.core.errors import RecipeError
from gsstream.input.recordings.options import SplitName
from gsstream.recipe.check import Model, join_problems, validate
from gsstream.recipe.document import Empty, Origin, read_file
from gsstream.recipe.shipped import recipe_file

SCHEMA_VERSION = "1.0"
_NAME = r"^[A-Za-z0-9][\w.+-]*$"


class Section(BaseModel):
    """Base of every section: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class Range(Section):
    """Where a random search draws a number from."""

    low: float = Field(description="least value")
    high: float = Field(description="largest value")
    log: bool = Field(default=False, description="draw the logarithm evenly")
    integer: bool = Field(default=False, description="round to an integer")

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError(f"expected low < high, above 0 with log; got {self.low:g} to {self.high:g}")
        return self


#: Values of a recipe key: a list, or for a random search a range.
Axis = list[Any] | Range


class Scene(Section):
    """A recording, and what it needs in a recipe."""

    name: str = Field(pattern=_NAME, description="name in tables")
    uri: str = Field(description="as for --source; a relative folder is looked up in --data")
    recipe: str | None = Field(
        default=None, description="recipe file with what this recording needs, or recording:NAME"
    )
    scale: float | None = Field(default=None, gt=0, le=1, description="images are downscaled by this factor")
    frames: int | None = Field(default=None, ge=1, description="number of frames; all when absent")
    set: dict[str, Any] = Field(default_factory=dict, description="recipe keys for this recording")


class Variant(Section):
    """A named recipe."""

    name: str = Field(pattern=_NAME, description="name in tables")
    method: str | None = Field(default=None, description="method whose recipe it starts from; default: the file's")
    recipe: str | None = Field(default=None, description="recipe file, relative to the sweep's file")
    base: str | None = Field(
        default=None,
        pattern=r"^[^#]+(#[^#]+)?$",
        description="FILE or FILE#NAME: start from the variant of that name (default: this one's) in another sweep's "
        "file, without the settings that file makes for all",
    )
    set: dict[str, Any] = Field(default_factory=dict, description="recipe keys, e.g. stream.epochs: 10")
    disturbed: str | None = Field(
        default=None,
        description="what is done to the recordings, e.g. noise_sigma=20: --source disturbed:KEY=VALUE,...:SOURCE, "
        "with the seed of the cell",
    )
    axes: dict[str, Axis] = Field(default_factory=dict, description="axes of this variant, besides those of all")
    first_frame: str | None = Field(
        default=None,
        description="with first_frame.share scene: the variant whose frame 0, of the same scene and seed, is taken "
        "over; default: the file's first",
    )
    base_seeds: list[int] = Field(
        default_factory=list,
        description="search 'each': further seeds of the variant as it is, to tell differences from noise",
    )

    @model_validator(mode="after")
    def _one_start(self) -> Variant:
        if self.base and (self.method or self.recipe):
            raise ValueError(f"variant {self.name}: base brings method and recipe file along; leave them out")
        return self


class FirstFrame(Section):
    """How frame 0 is shared."""

    share: Literal["exact", "scene", "own"] = Field(
        default="exact",
        description="exact: cells of one scene and seed with equal settings of frame 0 (structure included) share it; "
        "scene: all cells of a scene and seed take over the one of the first variant, or of the one that they name; "
        "own: none is shared",
    )
    seed: int | None = Field(default=None, ge=0, description="seed of a shared frame 0; default: the cell's own")

    @model_validator(mode="after")
    def _together(self) -> FirstFrame:
        if self.share == "own" and self.seed is not None:
            raise ValueError("seed belongs to a shared frame 0, but share is 'own'")
        return self


class Measure(Section):
    """What is measured on decoded frames besides PSNR, SSIM and moving pixels."""

    ms_ssim: bool = Field(default=False, description="multi-scale SSIM")
    flip: bool = Field(default=False, description="FLIP (extra: metrics)")
    fps: bool = Field(default=False, description="pictures per second of the last frame, by the player's renderer")
    lpips_onnx: str | None = Field(default=None, description="LPIPS by this ONNX file (docs/howto/lpips.md)")


class SweepConfig(Section):
    """A whole sweep: scenes x seeds x variants, each variant spread over the axes."""

    schema_version: Literal["1.0"] = Field(default="1.0", description="version of this schema")
    name: str = Field(pattern=_NAME, description="name of the sweep")
    description: str = Field(default="", description="what it is to show; printed in the report")
    paper_tables: dict[str, dict[str, str]] = Field(
        default_factory=dict,
        description="tables of the paper that the report puts beside ours: row -> variant where their names differ",
    )
    scenes: list[Scene] = Field(min_length=1, description="recordings")
    seeds: list[int] = Field(default=[0], min_length=1, description="seeds of every random stream")
    variants: list[Variant] = Field(min_length=1, description="named recipes")
    set: dict[str, Any] = Field(default_factory=dict, description="recipe keys of all variants")
    axes: dict[str, Axis] = Field(default_factory=dict, description="recipe key -> its values, for all variants")
    search: Literal["grid", "each", "random"] = Field(
        default="grid",
        description="grid: every combination of the axes; each: the variant, and one axis changed at a time; "
        "random: draws",
    )
    samples: int | None = Field(default=None, ge=1, description="random: draws per variant")
    search_seed: int = Field(default=0, ge=0, description="random: seed of the draws")
    first_frame: FirstFrame = Field(default=FirstFrame(), description="how frame 0 is shared")
    split: SplitName = Field(
        default="tuning",
        description="which cameras test (data.split of every cell): tuning, to choose settings by the sweep; "
        "reporting: the test cameras, for a table of results",
    )
    measure: Measure = Field(default=Measure(), description="what else is measured")

    @field_validator("seeds")
    @classmethod
    def _distinct_seeds(cls, seeds: list[int]) -> list[int]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise ValueError(f"expected different integers from 0 on, got {seeds}")
        return seeds

    @model_validator(mode="after")
    def _consistent(self) -> SweepConfig:
        for what, names in (("scenes", [s.name for s in self.scenes]), ("variants", [v.name for v in self.variants])):
            if len(set(names)) < len(names):
                raise ValueError(f"two {what} have the same name: {names}")
        for variant in self.variants:
            seeds = [*self.seeds, *variant.base_seeds]
            if variant.base_seeds and (self.search != "each" or len(set(seeds)) < len(seeds) or min(seeds) < 0):
                raise ValueError(
                    f"base_seeds of {variant.name}: expected search 'each' and integers from 0 on besides the sweep's "
                    f"seeds {self.seeds}; got search {self.search!r} and {variant.base_seeds}"
                )
        names = [variant.name for variant in self.variants]
        for variant in self.variants:
            if variant.first_frame and (variant.first_frame not in names or self.first_frame.share != "scene"):
                raise ValueError(
                    f"first_frame of {variant.name}: expected a variant of this file and first_frame.share scene; got "
                    f"{variant.first_frame!r} and {self.first_frame.share!r}; there are {names}"
                )
        unknown = {name for rows in self.paper_tables.values() for name in rows.values()} - set(names)
        if unknown:
            raise ValueError(f"paper_tables names variants that are not there: {sorted(unknown)}; there are {names}")
        axes = [*self.axes.items(), *(item for variant in self.variants for item in variant.axes.items())]
        for key, axis in axes:
            if isinstance(axis, Range) and self.search != "random":
                raise ValueError(f"axis {key} is a range, which only 'search: random' draws from; give a list")
            if isinstance(axis, list) and (not axis or len({json.dumps(v) for v in axis}) < len(axis)):
                raise ValueError(f"axis {key} needs at least one value and each only once, got {axis}")
        if (self.search == "random") != (self.samples is not None):
            raise ValueError("'samples' says how many draws 'search: random' makes; give both or neither")
        if self.search == "random" and not axes:
            raise ValueError("'search: random' needs axes to draw from")
        return self

    def leader_of(self, variant: Variant) -> Variant | None:
        """Return the variant whose frame 0 this one takes over; None: its own, or that of equal settings."""
        if self.first_frame.share != "scene":
            return None
        name = variant.first_frame or self.variants[0].name
        return next(other for other in self.variants if other.name == name)


class SceneList(Section):
    """A file of recordings that any sweep can run on."""

    scenes: list[Scene] = Field(min_length=1, description="recordings")


def read_sweep(path: Path, scenes: Path | None = None, split: SplitName | None = None) -> SweepConfig:
    """Read a sweep's YAML file. Raises RecipeError with file and line of every problem."""
    config = read_config(path, SweepConfig)
    if split is not None:
        config = config.model_copy(update={"split": split})
    if scenes is None:
        return config
    found = [
        scene.model_copy(update={"recipe": os.path.relpath(recipe_file(scene.recipe, scenes.parent), path.parent)})
        if scene.recipe
        else scene
        for scene in read_config(scenes, SceneList).scenes
    ]
    return SweepConfig.model_validate({**config.model_dump(), "scenes": [scene.model_dump() for scene in found]})


def read_config(path: Path, model: type[Model]) -> Model:
    """Read a YAML file as a model. Raises RecipeError with file and line of every problem."""
    layer = read_file(path)
    values: dict[str, Any] = {}
    for keys, leaf in layer.leaves.items():
        node = values
        for key in keys[:-1]:
            node = node.setdefault(key, {})
        node[keys[-1]] = {} if isinstance(leaf.value, Empty) else leaf.value

    def origin(keys: tuple[str, ...]) -> Origin:
        for end in range(len(keys), 0, -1):
            if keys[:end] in layer.marks:
                return layer.marks[keys[:end]]
        return Origin(str(path), str(path))

    problems: list[str] = []
    config = validate(model, values, origin, prefix=(), problems=problems)
    join_problems(problems, str(path))
    assert config is not None, "an invalid file leaves at least one problem"
    return config


def flat_settings(values: Mapping[str, Any], where: str) -> dict[tuple[str, ...], Any]:
    """Return ``{"gate.temperature": 0.3, "gate": {"name": "x"}}`` as key path -> value.

    Raises RecipeError for a bad key.
    """
    out: dict[tuple[str, ...], Any] = {}
    for key, value in values.items():
        path = tuple(key.split("."))
        if not all(re.fullmatch(r"\w[\w-]*", part) for part in path):
            raise RecipeError(f"{where}: expected a recipe key such as stream.epochs, got {key!r}")
        if isinstance(value, Mapping):
            out |= {(*path, *rest): below for rest, below in flat_settings(value, where).items()}
        else:
            out[path] = value
    return out
