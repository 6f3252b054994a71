"""The player's renderer: a compiled one that a plugin offers, else plain numpy with one warning.

A plugin offers one by an entry point of the group ``gsstream.player``::

    [project.entry-points."gsstream.player"]
    mine = "gsstream_mine.rasterizer:render_numpy"

The first name in the alphabet is used, unless ``gsstream play --renderer NAME`` names another. ``render_numpy`` is
a function that can be called like :func:`gsstream.player.software.render_numpy`, in a module that needs no torch. One
that has a parameter ``max_memory`` is given the bytes that it may take, and raises MemoryError before it takes more.
"""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import STRANGERS, InputError, PluginUnavailable, UnknownName
from gsstream.core.gaussians import Gaussians
from gsstream.core.install_hints import install_renderer
from gsstream.core.memory import VARIABLE, memory_limit, require_memory
from gsstream.core.shapes import FloatArray, check_finite, check_shape
from gsstream.player.blur import enlarged
from gsstream.player.software import render_numpy

ENTRY_POINT_GROUP = "gsstream.player"
#: Bytes of memory at the peak for every pixel of a picture, measured.
PER_PIXEL = 48


class PlayerRenderer(NamedTuple):
    """A renderer and the distribution that ships it."""

    name: str
    render_numpy: Callable[..., FloatArray]


class SlowRendererWarning(UserWarning):
    """No compiled renderer is installed; the player renders with numpy."""


@functools.cache
def find_renderer() -> PlayerRenderer:
    """Find the first compiled renderer that loads, in the order of names; else numpy. Warns once when it is numpy."""
    problems = []
    for point in _entry_points():
        try:
            return _load(point)
        except STRANGERS as error:  # third-party code: whatever it raises is reported, and the player still plays
            problems.append(f"{point.name} ({point.value}) failed: {type(error).__name__}: {error}")
    why = f". Reason: {'; '.join(problems)}" if problems else ""
    warnings.warn(
        "no compiled renderer works here, so pictures are drawn with plain numpy: about 100 times slower. To mend it, "
        f"{install_renderer()}{why}",
        SlowRendererWarning,
        stacklevel=2,
    )
    return PlayerRenderer("numpy", render_numpy)


def named_renderer(name: str) -> PlayerRenderer:
    """Return the renderer of this name: "numpy", or one that a plugin offers.

    Raises UnknownName for a name that is not registered, PluginUnavailable with the reason for one that does not load.
    """
    if name == "numpy":
        return PlayerRenderer("numpy", render_numpy)
    points = {point.name: point for point in _entry_points()}
    if name not in points:
        raise UnknownName("renderer of the player", name, ["numpy", *points])
    try:
        return _load(points[name])
    except STRANGERS as error:  # third-party code: whatever it raises is the reason
        value = points[name].value
        raise PluginUnavailable(f"renderer {name!r} ({value}) failed: {type(error).__name__}: {error}") from error


def _entry_points() -> list[importlib.metadata.EntryPoint]:
    return sorted(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name)


def _load(point: importlib.metadata.EntryPoint) -> PlayerRenderer:
    function = point.load()
    # Tried here, where another renderer can still be chosen, and not at the first picture.
    inspect.signature(function).bind([], None, None, 1, 1, (0.0, 0.0, 0.0), near=0.01)
    return PlayerRenderer(point.name, function)


def render(
    gaussians: Gaussians[FloatArray],
    cameras: Cameras,
    view: int = 0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    renderer: PlayerRenderer | None = None,
    scale: float = 1.0,
) -> FloatArray:
    """Render one camera of a rig: [H, W, 3] float32, not clamped above 1.

    Arguments:
        gaussians: N rows, raw values, numpy.
        cameras: the rig.
        view: index of one of them.
        background: colour behind everything, 0 to 1.
        renderer: that draws; None: the fastest that loads.
        scale: pixels of the picture for one of the recorded; above 1 it is as smooth as the recorded one, enlarged.

    Raises ShapeError when the renderer returns another shape or a value that is not finite, InputError when the picture
    would take more memory than :func:`gsstream.core.memory.memory_limit` allows.
    """
    chosen = find_renderer() if renderer is None else renderer
    size = (cameras.width, cameras.height)
    pose = (cameras.viewmats[view], cameras.Ks[view])
    what = f"drawing {len(gaussians)} Gaussians on {cameras.width} x {cameras.height} pixels"
    require_memory(cameras.width * cameras.height * PER_PIXEL, what)
    arrays = [array for _, array in enlarged(gaussians, *pose, scale).items()]
    limit = {"max_memory": memory_limit()} if _takes_limit(chosen.render_numpy) else {}
    try:
        image = chosen.render_numpy(arrays, *pose, *size, background, near=cameras.near_plane, **limit)
    except MemoryError as error:
        raise InputError(
            f"{what} takes too much memory: {error or 'the system has no more'}. Raise --max-memory, or the "
            f"environment variable {VARIABLE}, if you trust this input"
        ) from error
    check_shape(f"image of renderer {chosen.name!r}", image, (cameras.height, cameras.width, 3))
    check_finite(f"image of renderer {chosen.name!r}", image)
    return np.asarray(image, np.float32)


@functools.cache
def _takes_limit(function: Callable[..., FloatArray]) -> bool:
    return "max_memory" in inspect.signature(function).parameters


def to_bytes(image: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return [..., 3] colours in [0, 1] as 8 bits, rounded.

    Values outside are shown as the nearest displayable colour.
    """
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
