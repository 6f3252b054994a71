"""A list of recordings -> jobs. Nothing runs here."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from gsstream.recipe.document import Layer, Leaf, Origin
from gsstream.recipe.load import FindMethod, ResolvedRecipe, recipe_hash, resolve_recipe
from gsstream.recipe.shipped import recipe_file
from gsstream_lab.jobs.folder import recording_uri
from gsstream_lab.sweep.config import Scene, Section, flat_settings, read_config


class BatchConfig(Section):
    """What a batch is: recordings, and the recipe that all of them get."""

    method: str | None = Field(default=None, description="method; default: the recipe file's")
    recipe: str | None = Field(default=None, description="recipe file, or recording:NAME, of all recordings")
    set: dict[str, Any] = Field(default_factory=dict, description="recipe keys of all recordings")
    recordings: list[Scene] = Field(min_length=1, description="recordings, as the scenes of a sweep")

    @model_validator(mode="after")
    def _distinct(self) -> BatchConfig:
        names = [recording.name for recording in self.recordings]
        if len(set(names)) < len(names):
            raise ValueError(f"two recordings have the same name: {names}")
        return self


@dataclass(frozen=True, slots=True)
class Task:
    """One recording to be encoded. ``id``: digest of what decides the stream, so that equal ids are equal streams."""

    id: str
    name: str
    uri: str
    resolved: ResolvedRecipe

    @property
    def folder(self) -> str:
        """Where its results lie at the place of the batch."""
        return f"{self.name}-{self.id[:12]}"


def read_batch(path: Path, find_method: FindMethod) -> list[Task]:
    """Read a list and resolve the recipe of every recording.

    Raises RecipeError with file and line of every problem, UnknownName for a method that nobody has.
    """
    config = read_config(path, BatchConfig)
    return [_task(config, recording, path.parent, find_method) for recording in config.recordings]


def _task(config: BatchConfig, recording: Scene, folder: Path, find_method: FindMethod) -> Task:
    size = {"scale": recording.scale, "frames": recording.frames}
    written: list[tuple[str, Mapping[str, Any]]] = [
        ("set", config.set),
        (f"recording {recording.name}: set", recording.set),
        (f"recording {recording.name}", {key: value for key, value in size.items() if value is not None}),
    ]
    layers = []
    for where, values in written:
        origin = Origin(f"batch, {where}", f"batch, {where}")
        leaves = {path: Leaf(value, origin) for path, value in flat_settings(values, where).items()}
        layers.append(Layer(leaves, shorthand=True))
    files = [recipe_file(name, folder) for name in (config.recipe, recording.recipe) if name]
    resolved = resolve_recipe(config.method, find_method, files, layers=layers)
    uri = recording_uri(recording.uri, folder)
    text = json.dumps([uri, recipe_hash(resolved.recipe)])
    return Task(hashlib.sha256(text.encode()).hexdigest(), recording.name, uri, resolved)
