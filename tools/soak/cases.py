"""One random case of a soak run: a generated scene and a valid recipe, drawn from (seed, index) alone.

What is drawn: the scene (size, cameras, motion, noise), the method or its parts one by one, the engine's settings from
the table below, and the settings of every part from the ranges its own ``Config`` declares. Parts of other
distributions take part as soon as they are installed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from gsstream.core.errors import PluginUnavailable
from gsstream.core.kinds import METHOD_SLOTS
from gsstream.core.rng import Rng
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.recipe_keys import PART_SECTIONS, SESSION_KEYS

Generator = np.random.Generator
Draw = Callable[[Generator], Any]
#: Width, height: below, at and above one tile, long ones, and sizes that no tile divides.
SIZES = ((8, 8), (9, 8), (8, 40), (48, 8), (17, 13), (33, 25), (40, 30), (64, 48), (65, 49), (96, 72), (120, 90))
#: Up to this many pixels a case may take the reference renderer, which is hundreds of times slower.
REFERENCE_PIXELS = 250
#: The first cases are the largest: what is kept to be used again (the renderer's scratch memory) has its full size
#: before the resident sizes are compared, and is not taken for a leak.
LARGEST_FIRST = 16
#: Parts that need a file of the user's.
NEED_A_FILE = ("onnx",)


@dataclass(frozen=True, slots=True)
class Case:
    """What one run of a soak encodes; ``settings`` are (recipe key, value) in the order they are laid on."""

    seed: int
    index: int
    source: str
    method: str
    settings: tuple[tuple[str, Any], ...]

    @property
    def overrides(self) -> list[tuple[str, str]]:
        """The settings as the command line's ``--set``."""
        return [("--set", f"{key}={as_text(value)}") for key, value in self.settings]

    @property
    def command(self) -> str:
        """A command that encodes the same stream."""
        sets = " ".join(f"--set '{text}'" for _, text in self.overrides)
        return f"gsstream run --source '{self.source}' --method {self.method} {sets} --out DIR"


def _of(*values: Any) -> Draw:
    return lambda rng: values[int(rng.integers(len(values)))]


def _logs(low: float, high: float) -> Draw:
    return lambda rng: float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.4g}")


def _ints(low: int, high: int) -> Draw:
    return lambda rng: int(rng.integers(low, high + 1))


#: Settings that are drawn for every run; they keep the run short.
SHORT: Mapping[str, Draw] = MappingProxyType(
    {
        "seed": _ints(0, 10**6),
        "frames": _ints(2, 8),
        "first_frame.max_iterations": _of(0, 1, 10, 30, 60),
        "first_frame.max_points": _of(1, 5, 100, 400, 400, 1500, 1500),
        "first_frame.max_gaussians": _of(1, 50, 600, 3000, 3000, 3000),
        "stream.epochs": _ints(1, 4),
    }
)
#: Each drawn in some of the cases.
SOMETIMES: Mapping[str, Draw] = MappingProxyType({
    "scale": _of(1.0, 0.75, 0.5), "near": _logs(1e-3, 0.3),
    "first_frame.epochs": _of(0, 1, 3, 250), "first_frame.sh_degree": _ints(0, 3),
    "first_frame.points": _of("auto", "recording", "sparse", "sweep"),
    "first_frame.lr_means": _of(0.0, 1e-2),
    "first_frame.exposure": _of(True), "stream.active_threshold": _of(0.0, 0.05, 0.5, 0.99, 1.0),
    "stream.change_threshold": _of(0.0, 1.0, 6.0, 20.0, 100.0),
    "stream.rd_lambda": _of(0.0, 1e-5, 3e-4, 1e-2, 1.0), "stream.on_error": _of("raise", "repeat"),
    "stream.progressive": _of(False, True),
    "stream.lr_final_factor": _of(1.0, 0.1, 1e-6),
    "codec.key_interval": _of(0, 1, 2, 3),
    "data.leak": _of("none", "points", "training"),
})  # fmt: skip
#: Drawn with the others where the method is made of parts.
OF_PARTS: Mapping[str, Draw] = MappingProxyType(
    {
        "codec.trim": _of(0.0, 0.3, 0.9, 0.999),
        "budget.size": _of(16, 200, 1500, 20_000),
        "budget.time": _logs(1e-3, 2),
    }
)


def draw_case(seed: int, index: int, catalog: Catalog) -> Case:
    """The case of a place in a soak. Some are refused when they are assembled, which is for the caller to count."""
    rng = Rng(seed).numpy("soak", index)
    largest = index < LARGEST_FIRST
    width, height = SIZES[-1] if largest else SIZES[int(rng.integers(len(SIZES)))]
    views = 8 if largest else int(rng.integers(2, 9))
    scene = {
        "frames": 8, "views": views, "width": width, "height": height, "seed": int(rng.integers(1000)),
        "motion": _of(0, 0.2, 1, 1, 5, 5, 20)(rng), "noise": _of(0, 0, 0.01, 0.1)(rng),
        "static": _of(0, 0, 0, 0, 0, 0, 1)(rng),
        "shadows": _of(0, 1)(rng), "supersample": _of(1, 2)(rng),
    }  # fmt: skip
    source = "synthetic:" + "&".join(f"{key}={value}" for key, value in scene.items())
    names = catalog.names("method")
    method = _of(*names, *(name for name in names if name != "hold"))(rng)  # nothing ever happens in hold
    settings = {key: draw(rng) for key, draw in SHORT.items()}
    if largest:
        settings |= {"first_frame.max_points": 1500, "first_frame.max_gaussians": 3000}
    share = _of(0.0, 0.1, 0.3)(rng)
    settings |= {key: draw(rng) for key, draw in SOMETIMES.items() if rng.random() < share}
    if views > 2 and rng.random() < 0.1:
        settings["data.train_views"] = int(rng.integers(2, views))
    if width * height <= REFERENCE_PIXELS and rng.random() < 0.2:
        settings["renderer"] = "reference"
    streaming_method = streaming_method_of(method, catalog)
    if streaming_method is not None:
        recipe_keys = getattr(catalog.resolve("streaming_method", streaming_method), "recipe_keys", ())
        read = (*recipe_keys, *SESSION_KEYS)
        settings = {k: v for k, v in settings.items() if k in read or k.partition(".")[0] not in PART_SECTIONS}
        settings |= dict(_settings_of(catalog, "streaming_method", streaming_method, rng, share))
    else:
        settings |= {key: draw(rng) for key, draw in OF_PARTS.items() if rng.random() < share}
        settings |= _parts(catalog, rng, share)
    return Case(seed, index, source, method, tuple(settings.items()))


def streaming_method_of(method: str, catalog: Catalog) -> str | None:
    """The streaming_method behind a method's name; None where it is made of parts."""
    from gsstream.recipe.load import resolve_recipe

    name = resolve_recipe(method, catalog.recipe_path).recipe.streaming_method.name
    return None if name == "parts" else name


def _parts(catalog: Catalog, rng: Generator, share: float) -> dict[str, Any]:
    """Other parts in some of the slots, and settings of theirs."""
    settings: dict[str, Any] = {}
    swap = _of(0.0, 0.3, 1.0)(rng)
    for slot in METHOD_SLOTS:
        if rng.random() >= swap:
            continue
        name = _of(*usable(catalog, slot))(rng)
        settings[f"{slot}.name"] = name
        settings |= dict(_settings_of(catalog, slot, name, rng, share))
    return settings


def usable(catalog: Catalog, slot: str) -> list[str]:
    """Parts of a slot that work here without settings of their own."""
    names = []
    for name in (name for name in catalog.names(slot) if name not in NEED_A_FILE):
        try:
            catalog.resolve(slot, name).Config()
        except (PluginUnavailable, ValidationError):
            continue
        names.append(name)
    return names


def _settings_of(catalog: Catalog, slot: str, name: str, rng: Generator, share: float) -> Iterator[tuple[str, Any]]:
    part = catalog.resolve(slot, name)
    yield from _fields(part.Config(), f"{slot}.params", rng, share)


def _fields(config: BaseModel, path: str, rng: Generator, share: float) -> Iterator[tuple[str, Any]]:
    """Some of the settings of a section, nested sections included, each with a value from its own range."""
    for name, info in type(config).model_fields.items():
        usual = getattr(config, name)
        if isinstance(usual, BaseModel):
            yield from _fields(usual, f"{path}.{name}", rng, share)
        elif rng.random() < share and (value := draw_value(info, usual, rng)) is not None:
            yield f"{path}.{name}", value


def draw_value(info: FieldInfo, usual: Any, rng: Generator) -> Any:
    """A valid value of a field: any choice; a number up to eight times and down to an eighth of the usual one.

    None where the kind of field has no such draw (texts, lists).
    """
    if get_origin(info.annotation) is Literal:
        return _of(*get_args(info.annotation))(rng)
    if isinstance(usual, bool):
        return bool(rng.integers(2))
    if not isinstance(usual, int | float):
        return None
    low, high, least, most = _bounds(info)
    value = usual * math.exp(rng.uniform(-math.log(8), math.log(8))) if usual else float(rng.integers(0, 3))
    if isinstance(usual, int):
        return round(min(max(round(value), least, low + 1), most, high - 1))  # bounds of whole numbers are whole
    if rng.random() < 0.1 and math.isfinite(edge := _of(least, most)(rng)):
        value = edge
    value = float(f"{min(max(value, least), most):.4g}")
    return value if low < value < high else usual


def _bounds(info: FieldInfo) -> tuple[float, float, float, float]:
    """(above, below, at least, at most) of a number."""
    usual = {"gt": -math.inf, "lt": math.inf, "ge": -math.inf, "le": math.inf}
    found = {key: float(getattr(item, key)) for item in info.metadata for key in usual if hasattr(item, key)}
    bounds = {**usual, **found}
    return bounds["gt"], bounds["lt"], bounds["ge"], bounds["le"]


def as_text(value: Any) -> str:
    """A value as the command line takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(as_text, value))}]" if isinstance(value, tuple) else str(value)
