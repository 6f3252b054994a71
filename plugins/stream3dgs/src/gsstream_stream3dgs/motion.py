"""Fitting the transformation cache to the images of a frame."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import (
    Cameras,
    Field,
    FieldShape,
    FitContext,
    Gaussians,
    IntArray,
    Motion,
    Rng,
    Scene,
    WrtRows,
    field_rows,
)
from gsstream.blocks import approximate_by_cells, pixel_size, rows_backward
from gsstream_stream3dgs.cache import Cache, Lookup
from gsstream_stream3dgs.settings import CacheSettings


def fitted_cache(
    scene: Scene, work: FitContext, rows: IntArray, epochs: int, settings: CacheSettings, rng: Rng
) -> tuple[IntArray, Cache] | None:
    """Return the cache of a frame and the rows [A] that it moves; None where none may move."""
    shape = shape_of(scene, work.cameras.extent, settings, rng)
    marks = np.zeros(len(scene.gaussians), np.uint8)
    marks[rows] = 1
    rows, unit = field_rows(scene, shape, marks)
    if not len(rows):
        return None
    cache = Cache(shape, Lookup(shape, unit), settings.entry_step, settings.weight_step)
    base = scene.gaussians.rows(rows).map(torch.from_numpy)
    work.narrow(torch.from_numpy(rows))
    order = rng.numpy("stream3dgs/order", work.index)
    for epoch in range(epochs):
        rounded = settings.sent == "field" and epoch >= epochs * (1 - settings.rounded)
        for view in order.permutation(len(work.cameras)):
            shift, turn = cache(rounded)
            there = moved(base, shape.reach * shift, turn)
            rows_backward(there, work.loss_and_grad(int(view), WrtRows(there)).grad)
            cache.step(settings.lr)
    return rows, cache


def shape_of(scene: Scene, extent: float, settings: CacheSettings, rng: Rng) -> FieldShape:
    """Return the shape of a frame's field: its box is that of most Gaussians, its first weights those of every frame.
    """
    means = scene.gaussians.means.astype(np.float64)
    low, high = np.quantile(means, [settings.box, 1 - settings.box], axis=0).astype(np.float32)
    # A scene that is flat along an axis has a box all the same.
    high = np.maximum(high, low + np.maximum(np.float32(1e-3 * extent), np.float32(1e-6) * np.abs(low)))
    return FieldShape(
        (float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2])),
        float(np.float32(settings.reach * extent)), settings.levels, settings.entries, settings.features, settings.base,
        float(np.float32(settings.growth)), settings.width, 2, rng.key("stream3dgs", 0) & 0xFFFFFFFF,
    )  # fmt: skip


def coded_cache(
    scene: Scene, rows: IntArray, cache: Cache, cameras: Cameras, settings: CacheSettings
) -> Field | Motion | None:
    """Return what is sent of a cache: the cache, or the rigid motions of cells; None where nothing moves."""
    if settings.sent == "field":
        if len(rows) == len(scene.gaussians):
            return cache.field(None)
        marks = np.zeros(len(scene.gaussians), np.uint8)
        marks[rows] = 1
        return cache.field(marks)
    with torch.no_grad():
        shift, turn = cache()
    pixel = pixel_size(scene.gaussians.means, cameras)
    side = float(np.float32(settings.pixels * pixel))
    return approximate_by_cells(
        scene, rows, (cache.shape.reach * shift).numpy(), turn.numpy(), side, settings.step * pixel
    )


def moved(gaussians: Gaussians[torch.Tensor], shift: torch.Tensor, turn: torch.Tensor) -> Gaussians[torch.Tensor]:
    """Return Gaussians, raw values, shifted and turned."""
    quat = torch.nn.functional.normalize(torch.cat([torch.ones_like(turn[:, :1]), turn], 1), dim=1)
    w0, x0, y0, z0 = quat.unbind(1)
    w1, x1, y1, z1 = gaussians.quats.unbind(1)
    quats = torch.stack([
        w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
        w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
        w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
        w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
    ], 1)  # fmt: skip
    return Gaussians(**{**dict(gaussians.items()), "means": gaussians.means + shift, "quats": quats})
