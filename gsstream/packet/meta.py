"""StreamMeta: what a key packet says about the run, as JSON."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsstream import __version__
from gsstream.core.cameras import Cameras
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.names import check_camera_ids

#: Conventions every value of a stream of this format follows.
CONVENTIONS: Mapping[str, str] = {
    "viewmats": "world-to-camera, OpenCV axes", "Ks": "pixels, pixel-corner origin", "quats": "wxyz",
    "scales": "log", "opacities": "logit", "colour": "0.5 + sum of real spherical harmonics, clamped at 0",
    "blur": "0.3 px", "alpha": "cut 1/255, clamp 0.999, transmittance above 1e-4",
    "near": "scene units, per rig",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class StreamMeta:
    """What a player, a report or a resumed run must know besides the Gaussians.

    Arguments:
        method: name of the method that wrote the stream.
        source: name of the recording.
        recipe: the resolved recipe, plain JSON values.
        train, test: the rig by split.
        fps: frames per second.
        background: colour behind everything, [0, 1].
        plugins: distribution -> version of every plugin that took part.
        conventions: how the numbers are to be read.
        version: gsstream that wrote the stream.
        extra: anything else, plain JSON values.
    """

    method: str
    source: str
    recipe: Mapping[str, Any]
    train: Cameras
    test: Cameras
    fps: float
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    plugins: Mapping[str, str] = field(default_factory=dict)
    conventions: Mapping[str, str] = field(default_factory=lambda: dict(CONVENTIONS))
    version: str = __version__
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def recipe_hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the recipe's canonical JSON."""
        return hash_recipe(self.recipe)

    def camera(self, name: str) -> Cameras:
        """The one camera with this id, test cameras first. Raises ShapeError naming the known ones."""
        for rig in (self.test, self.train):
            if name in rig.ids:
                return rig.select([rig.ids.index(name)])
        raise ShapeError(f"no camera {name!r} in this stream; known: {', '.join((*self.test.ids, *self.train.ids))}")


def hash_recipe(recipe: Mapping[str, Any]) -> str:
    """First 16 hex digits of the SHA-256 of the canonical JSON (sorted keys, no spaces)."""
    text = json.dumps(recipe, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def meta_to_json(meta: StreamMeta) -> bytes:
    """UTF-8 JSON. Floats keep every bit (shortest representation that reads back)."""
    data = {
        "version": meta.version, "method": meta.method, "source": meta.source, "recipe": meta.recipe,
        "recipe_hash": meta.recipe_hash, "plugins": meta.plugins, "fps": meta.fps, "background": meta.background,
        "conventions": meta.conventions, "train": _rig(meta.train), "test": _rig(meta.test), "extra": meta.extra,
    }  # fmt: skip
    return json.dumps(data, separators=(",", ":"), allow_nan=False, default=_plain).encode()


def meta_from_json(data: bytes) -> StreamMeta:
    """Inverse of :func:`meta_to_json`. Raises PacketError (without offset)."""
    try:
        value = json.loads(data, parse_constant=_refuse)
        meta = StreamMeta(
            method=_text(value["method"]), source=_text(value["source"]), recipe=_object(value["recipe"]),
            train=_cameras(value["train"]), test=_cameras(value["test"]), fps=float(value["fps"]),
            background=_color(value["background"]), plugins=_object(value["plugins"]),
            conventions=_object(value["conventions"]), version=_text(value["version"]), extra=_object(value["extra"]),
        )  # fmt: skip
        recorded = value["recipe_hash"]
    except KeyError as error:
        raise PacketError(f"meta: the entry {error} is missing") from error
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise PacketError(f"meta: not what was expected: {error}") from error
    if recorded != meta.recipe_hash:
        raise PacketError(f"meta: recipe hash {recorded!r} does not belong to the recipe ({meta.recipe_hash})")
    return meta


def _rig(cameras: Cameras) -> dict[str, Any]:
    check_camera_ids(cameras.ids)
    return {
        "ids": list(cameras.ids), "width": cameras.width, "height": cameras.height, "near": cameras.near,
        "viewmats": np.asarray(cameras.viewmats, np.float64).reshape(-1, 16).tolist(),
        "Ks": np.asarray(cameras.Ks, np.float64).reshape(-1, 9).tolist(),
    }  # fmt: skip


def _cameras(value: Any) -> Cameras:
    ids = tuple(_text(name) for name in value["ids"])
    check_camera_ids(ids)
    viewmats = np.asarray(value["viewmats"], np.float64).reshape(len(ids), 4, 4)
    Ks = np.asarray(value["Ks"], np.float64).reshape(len(ids), 3, 3)
    cameras = Cameras(ids, viewmats, Ks, int(value["width"]), int(value["height"]), float(value["near"]))
    if not (0 <= cameras.width <= 1 << 16 and 0 <= cameras.height <= 1 << 16):
        raise ValueError(f"image size {cameras.width} x {cameras.height} is beyond 65536")
    cameras.validate()
    return cameras


def _color(value: Any) -> tuple[float, float, float]:
    red, green, blue = (float(v) for v in value)
    return red, green, blue


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected text, got {type(value).__name__}")
    return value


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"expected an object, got {type(value).__name__}")
    return value


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"meta: {type(value).__name__} cannot be written as JSON")
