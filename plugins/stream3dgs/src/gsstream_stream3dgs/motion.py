"""Motion by a transformation cache: the fit to the images of a frame, and the change that is sent."""

from __future__ import annotations

from typing import Any, Literal, final

import numpy as np
import pydantic
import torch

from gsstream.api import (
    Field,
    FieldShape,
    FitContext,
    IntArray,
    Motion,
    MotionPart,
    PartConfig,
    Rng,
    Scene,
    WrtRows,
    field_rows,
)
from gsstream.blocks import approximate_by_cells, enlargement, pixel_size, rows_backward, transform_rows
from gsstream_stream3dgs.cache import Cache, Lookup

Setting = pydantic.Field
#: Cells along an axis of a resolution of the grid, divided by those of the next coarser one.
GROWTH = 2.0
#: A Gaussian takes part when it lies in changed tiles in at least this share of the views that show it.
VOTES = 0.75
#: Quantisation step of the network's weights.
WEIGHT_STEP = 0.02
#: Side of the cells that are sent instead of the weights, pixels at a width of 320.
CELL = 6.0


@final
class CacheMotion(MotionPart):
    """Moves Gaussians by a hash grid with a small network, fitted in every frame (3DGStream: Sun et al., CVPR 2024).

    It gives every Gaussian in a box a translation and a rotation. What is sent are its weights or, instead of them, the
    rigid motions of small cells that come nearest to what it does. Gaussians that were added since the last key packet
    do not move, and the fit does not see them. Defaults are the published values where a value is known; where this
    differs, and why, is in the README of this plugin.
    """

    source = "3DGStream (Sun et al. 2024)"
    processor_only = "its hash grid is looked up by numpy"

    class Config(PartConfig):
        epochs: int = Setting(default=8, ge=1, le=1000, description="passes over the training cameras")
        levels: int = Setting(default=16, ge=1, le=16, description="resolutions of the hash grid")
        entries: int = Setting(default=15, ge=4, le=20, description="log2 of the entries of a resolution")
        features: int = Setting(default=4, ge=1, le=8, description="numbers of an entry")
        base: int = Setting(default=16, ge=2, le=1024, description="cells along an axis at the coarsest resolution")
        width: int = Setting(default=64, ge=4, le=128, description="neurons of each of the two hidden layers")
        lr: float = Setting(default=2e-3, gt=0, le=1, description="Adam learning rate of all weights")
        reach: float = Setting(
            default=0.1, gt=0, description="translation of one unit of the network, fraction of the extent"
        )
        box: float = Setting(
            default=0.02, ge=0, lt=0.5, description="share of the Gaussians outside the box at either end of each axis"
        )
        sent: Literal["field", "cells"] = Setting(
            default="field",
            description="field: the weights, as published; cells: rigid motions of cells, far fewer bytes",
        )
        entry_step: float = Setting(default=0.05, gt=0, le=1, description="quantisation step of the grid's entries")
        rounded: float = Setting(
            default=0.5, ge=0, le=1, description="share of the passes, the last, that learn with rounded weights"
        )
        step: float = Setting(default=0.1, gt=0, le=10, description="sent as cells: quantisation step, pixels")

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion | Field, ...]:
        rows = work.changed_rows(VOTES).nonzero()[:, 0].numpy()
        rows = rows[rows < work.key_rows]
        if not len(rows):
            return ()
        found = self.fitted(scene, work.on(work.gaussians.rows(slice(0, work.key_rows))), rows, rng)
        said = None if found is None else self.said(scene, *found, work)
        return () if said is None else (said,)

    def fitted(self, scene: Scene, work: FitContext, rows: IntArray, rng: Rng) -> tuple[IntArray, Cache] | None:
        """Return the rows [A] that the cache of a frame moves, and the cache; None where none may move."""
        config = self.config
        shape = self.shape(scene, work.cameras.extent, rng)
        marks = np.zeros(len(scene.gaussians), np.uint8)
        marks[rows] = 1
        rows, unit = field_rows(scene, shape, marks)
        if not len(rows):
            return None
        cache = Cache(shape, Lookup(shape, unit), config.entry_step, WEIGHT_STEP)
        base = scene.gaussians.rows(rows).map(torch.from_numpy)
        work.narrow(torch.from_numpy(rows))
        order, epochs = rng.numpy("stream3dgs/order", work.index), work.scaled(config.epochs)
        for epoch in range(epochs):
            rounded = config.sent == "field" and epoch >= epochs * (1 - config.rounded)
            for view in order.permutation(len(work.cameras)):
                shift, turn = cache(rounded)
                there = transform_rows(base, shape.reach * shift, turn)
                rows_backward(there, work.loss_and_grad(int(view), WrtRows(there)).grad)
                cache.step(config.lr)
        return rows, cache

    def shape(self, scene: Scene, extent: float, rng: Rng) -> FieldShape:
        """Return the shape of a frame's field: its box is that of most Gaussians, its first weights those of every
        frame.
        """
        config, means = self.config, scene.gaussians.means.astype(np.float64)
        low, high = np.quantile(means, [config.box, 1 - config.box], axis=0).astype(np.float32)
        # A scene that is flat along an axis has a box all the same.
        high = np.maximum(high, low + np.maximum(np.float32(1e-3 * extent), np.float32(1e-6) * np.abs(low)))
        return FieldShape(
            low=(float(low[0]), float(low[1]), float(low[2])),
            high=(float(high[0]), float(high[1]), float(high[2])),
            reach=float(np.float32(config.reach * extent)),
            levels=config.levels,
            entries=config.entries,
            features=config.features,
            base=config.base,
            growth=GROWTH,
            width=config.width,
            layers=2,
            seed=rng.key("stream3dgs", 0) & 0xFFFFFFFF,
        )

    def said(self, scene: Scene, rows: IntArray, cache: Cache, work: FitContext) -> Field | Motion | None:
        """Return what is sent of a cache: the cache, or the rigid motions of cells; None where nothing moves."""
        if self.config.sent == "field":
            marks = np.zeros(len(scene.gaussians), np.uint8)
            marks[rows] = 1
            return cache.field(None if marks.all() else marks)
        with torch.no_grad():
            shift, turn = cache()
        pixel = pixel_size(scene.gaussians.means, work.cameras)
        side = float(np.float32(CELL * enlargement(work.cameras.width) * pixel))
        return approximate_by_cells(
            scene,
            rows,
            work.shell_rows,
            translation=(cache.shape.reach * shift).numpy(),
            rotation=turn.numpy(),
            side=side,
            step=self.config.step * pixel,
        )
