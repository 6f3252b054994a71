"""StreamMeta: the description of the run in a key packet, as JSON. Writers refuse everything that readers refuse."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from gsstream import __version__
from gsstream.core.cameras import Cameras
from gsstream.core.digest import hash_recipe
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.names import check_camera_ids
from gsstream.core.shapes import FloatArray
from gsstream.core.world import IDENTITY, World
from gsstream.packet.base import MAX_META

MAX_SIDE, MAX_PIXELS = 1 << 16, 1 << 27
MIN_FPS, MAX_FPS = 0.01, 100_000.0
#: Arrays and objects within each other; a parser may need much memory or stack for more.
MAX_DEPTH = 100
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
        world: where the stream's coordinates lie in those of the recording.
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
    world: World = IDENTITY

    @property
    def recipe_hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the recipe's canonical JSON."""
        return hash_recipe(self.recipe)

    @property
    def title(self) -> str:
        """The method, and the changed settings of its recipe where the encoder wrote them."""
        return str(self.extra.get("title") or self.method)

    def camera(self, name: str) -> Cameras:
        """Return the one camera with this id, test cameras first. Raises ShapeError naming the known ones."""
        for rig in (self.test, self.train):
            if name in rig.ids:
                return rig.select([rig.ids.index(name)])
        raise ShapeError(f"no camera {name!r} in this stream; known: {', '.join((*self.test.ids, *self.train.ids))}")


def meta_to_json(meta: StreamMeta) -> bytes:
    """Return the meta as JSON in UTF-8. Floats keep every bit (shortest representation that reads back).

    Raises ShapeError for values that readers refuse.
    """
    try:
        _check(meta)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"meta: {error}") from error
    data = {
        "version": meta.version, "method": meta.method, "source": meta.source, "recipe": meta.recipe,
        "recipe_hash": meta.recipe_hash, "plugins": meta.plugins, "fps": meta.fps, "background": meta.background,
        "conventions": meta.conventions, "train": _rig(meta.train), "test": _rig(meta.test), "extra": meta.extra,
    }  # fmt: skip
    if not meta.world.is_identity:
        data["world"] = asdict(meta.world)
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, default=_plain).encode()
    if len(text) > MAX_META or _nested_too_deep(text):
        raise ShapeError(
            f"meta: expected at most {MAX_META} bytes of JSON, nested at most {MAX_DEPTH} deep, got {len(text)} bytes: "
            "recipe or extra is too large"
        )
    return text


def meta_from_json(data: bytes) -> StreamMeta:
    """Return the meta of which :func:`meta_to_json` made these bytes. Raises PacketError (without offset)."""
    try:
        if _nested_too_deep(data):
            raise ValueError(f"arrays and objects lie more than {MAX_DEPTH} deep within each other")
        # As text: the parser would guess the encoding of bytes.
        value = _object(json.loads(data.decode("utf-8"), parse_constant=_refuse, parse_float=_finite))
        meta = StreamMeta(
            method=_text(value["method"]),
            source=_text(value["source"]),
            recipe=_object(value["recipe"]),
            train=_cameras(value["train"]),
            test=_cameras(value["test"]),
            fps=_number(value["fps"]),
            background=_color(value["background"]),
            plugins=_object(value["plugins"]),
            conventions=_object(value["conventions"]),
            version=_text(value["version"]),
            extra=_object(value["extra"]),
            world=_world(value["world"]) if "world" in value else IDENTITY,
        )
        _check(meta)
        recorded, computed = value["recipe_hash"], meta.recipe_hash
    except KeyError as error:
        raise PacketError(f"meta: the entry {error} is missing") from error
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise PacketError(f"meta: not what was expected: {error}") from error
    if recorded != computed:
        raise PacketError(f"meta: recipe hash {str(recorded)[:40]!r} does not belong to the recipe ({computed})")
    return meta


def _check(meta: StreamMeta) -> None:
    """Everything that must hold of a stream's meta besides its types. Raises TypeError or ValueError."""
    if not MIN_FPS <= meta.fps <= MAX_FPS:
        raise ValueError(f"fps: expected {MIN_FPS:g} to {MAX_FPS:g} frames per second, got {meta.fps!r}")
    _check_single("background", meta.background)
    if not len(meta.train) + len(meta.test):
        raise ValueError("there is no camera; expected at least one in train or test")
    for rig in (meta.train, meta.test):
        check_camera_ids(rig.ids)
        for side in (rig.width, rig.height):
            if not 1 <= side <= MAX_SIDE:
                raise ValueError(f"image size {rig.width} x {rig.height}: expected 1 to {MAX_SIDE} pixels a side")
        if rig.width * rig.height > MAX_PIXELS:
            raise ValueError(f"image size {rig.width} x {rig.height}: expected at most {MAX_PIXELS} pixels")
        _check_single("viewmats", rig.viewmats)
        _check_single("Ks", rig.Ks)
        _check_single("near", [rig.near_plane], above_zero=True)
        _check_single("focal lengths", rig.Ks[:, [0, 1], [0, 1]], above_zero=True)
    meta.world.validate()
    for name, version in meta.plugins.items():
        _text(name), _text(version)
    for key in ("source_uri", "licence", "title"):
        _text(meta.extra.get(key, ""))
    _check_encoder_s_own(meta)


def _check_single(name: str, values: Any, *, above_zero: bool = False) -> None:
    """Raise ValueError unless numbers are finite, and above 0 if they must be, in the float32 of renderers."""
    with np.errstate(over="ignore", under="ignore"):
        single = np.asarray(values, np.float64).astype(np.float32)
    if not (np.isfinite(single) & ((single > 0) | (not above_zero))).all():
        wanted = "finite numbers above 0" if above_zero else "finite numbers"
        raise ValueError(f"{name}: expected {wanted} in float32, got {np.ravel(values)}")


def _nested_too_deep(text: bytes) -> bool:
    """Say whether more than MAX_DEPTH arrays and objects of a JSON text lie within each other."""
    depth = 0
    for found in _STRUCTURE.finditer(text):
        sign = found[0][:1]
        depth += (sign in b"[{") - (sign in b"]}")
        if depth > MAX_DEPTH:
            return True
    return False


#: A text, whatever is in it and also without an end, or one bracket. It takes one way through any input.
_STRUCTURE = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"?|[\[\]{}]', re.DOTALL)


def _check_encoder_s_own(meta: StreamMeta) -> None:
    """Values that an encoder leaves for one that goes on from this scene: the origin of its grid and colour maps."""
    extra = meta.extra
    if "origin" in extra:
        _array("extra.origin", extra["origin"], (3,))
    if "exposure" in extra:
        maps, cameras = _object(extra["exposure"]), len(meta.train)
        _array("extra.exposure.matrix", maps.get("matrix"), (cameras, 3, 3))
        _array("extra.exposure.offset", maps.get("offset"), (cameras, 3))
    if "gains" in extra:
        _array("extra.gains", extra["gains"], (len(meta.train), 3))
        _check_single("extra.gains", extra["gains"], above_zero=True)  # an encoder divides by them
    shown = extra.get("shown", 0)
    if isinstance(shown, bool) or not isinstance(shown, int) or shown < 0:
        raise ValueError(f"extra.shown: expected the number of a frame, got {shown!r:.60}")


def _array(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """Hold nested lists of numbers against a shape. Raises ValueError."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: expected numbers in the shape {list(shape)}: {error}") from error
    if array.shape != shape or not (np.abs(array) < 3.4e38).all():
        raise ValueError(f"{name}: expected finite numbers in the shape {list(shape)}, got {array.shape}")


def _rig(cameras: Cameras) -> dict[str, Any]:
    return {
        "ids": list(cameras.ids),
        "width": cameras.width,
        "height": cameras.height,
        "near": cameras.near_plane,
        "viewmats": np.asarray(cameras.viewmats, np.float64).reshape(-1, 16).tolist(),
        "Ks": np.asarray(cameras.Ks, np.float64).reshape(-1, 9).tolist(),
    }


def _cameras(value: Any) -> Cameras:
    value = _object(value)
    ids = tuple(_text(name) for name in _list(value["ids"]))
    viewmats = _matrices(value["viewmats"], len(ids), 4)
    Ks = _matrices(value["Ks"], len(ids), 3)
    cameras = Cameras(
        ids=ids,
        viewmats=viewmats,
        Ks=Ks,
        width=_whole(value["width"]),
        height=_whole(value["height"]),
        near_plane=_number(value["near"]),
    )
    cameras.validate()
    return cameras


def _matrices(value: Any, number: int, side: int) -> FloatArray:
    """[number, side, side] from a list of lists of numbers, row by row."""
    rows = [[_number(v) for v in _list(row)] for row in _list(value)]
    if len(rows) != number or any(len(row) != side * side for row in rows):
        raise ValueError(f"cameras: expected {number} matrices of {side * side} numbers")
    return np.array(rows, np.float64).reshape(number, side, side)


def _world(value: Any) -> World:
    value = _object(value)
    rotation, offset = (tuple(_number(v) for v in _list(value[key])) for key in ("rotation", "offset"))
    return World(rotation, offset, _number(value["scale"]))


def _color(value: Any) -> tuple[float, float, float]:
    red, green, blue = (_number(v) for v in _list(value))
    return red, green, blue


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected text, got {type(value).__name__}")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"expected a number, got {type(value).__name__}")
    return float(value)


def _whole(value: Any) -> int:
    # 32.0 is a whole number in JSON.
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise TypeError(f"expected a whole number, got {str(value)[:40]!r}")
    return int(value)


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"expected an array, got {type(value).__name__}")
    return value


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"expected an object, got {type(value).__name__}")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):  # 1e999 is well-formed JSON
        raise ValueError(f"{text[:40]} is not a finite number")
    return value


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"meta: {type(value).__name__} cannot be written as JSON")
