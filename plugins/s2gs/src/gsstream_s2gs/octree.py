"""The streaming octree: where Gaussians start, and which of them share a gate."""

from __future__ import annotations

import math
from typing import Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator

from gsstream.api import (
    Anchors,
    Cameras,
    Gaussians,
    Hierarchy,
    InputError,
    PartConfig,
    PointCloud,
    Structure,
    StructureTraits,
    check_finite,
    check_shape,
)
from gsstream_s2gs import morton

#: Cells on either side of the root cube that are told apart when Gaussians are grouped; farther ones share the last.
FAR_CELLS = 1 << (morton.AXIS_BITS - 1)


@final
class StreamingOctree(Structure):
    """Anchors at several resolutions of one cube, weeded by camera distance; a region is a cell of the root grid.

    Seeding (paper, "Streaming Octree Representation" and its appendix; quantities the paper leaves open follow the
    released code):

    1. D_max and D_min are the ``distance_quantile`` and its complement of the point-camera distances, first per
       training camera, then over all cameras. Levels: H = round(log_b(D_max / D_min)) + 1, at most ``max_levels``.
    2. A cube of side S around the points, each side ``padding`` times the largest extent away from them. The
       released code multiplies coordinates by 1.1, which cuts points off when all lie on one side of the origin.
    3. Level l has cells of side s_l = S / 2^(k + l), k = ``root_exponent``; each occupied cell is a candidate with an
       anchor at its centre (paper; released: lower corner) and the mean colour of its points (released: maximum).
    4. A candidate stays if its level is at most clamp(floor(log_b(D_max / d)), 0, H - 1) for more than
       ``visible_threshold`` of the training cameras, d being its distance to the camera. Level 0 always stays.

    Grouping: a Gaussian belongs to the cell of its centre in the grid ``gate_level`` levels below the root grid;
    with 0 the M nodes are the R root regions. Nodes of one level are numbered along a Morton curve, so Gaussians
    stored node by node lie near their neighbours. Gaussians 2^20 cells or more from the cube share outermost cells.
    """

    source = "S2GS, streaming octree"

    class Config(PartConfig):
        root_exponent: int = Field(
            default=8, ge=0, le=20, description="k, the root grid has 2^k cells per axis, 0 to 20 (paper: 8, 9 or 12)"
        )
        log_base: float = Field(
            default=1.5, ge=1.05, le=16, description="b, distance ratio of two levels, 1.05 to 16 (paper: 1.2 to 3)"
        )
        max_levels: int = Field(
            default=10,
            ge=1,
            le=21,
            description="upper bound on the number of levels H, 1 to 21; root_exponent + max_levels <= 22",
        )
        distance_quantile: float = Field(
            default=0.999, gt=0.5, le=1, description="quantile of distances taken as D_max, 0.5 to 1 (released)"
        )
        visible_threshold: float = Field(
            default=0.9, ge=0, lt=1, description="share of cameras that must ask for a level, 0 to 1 (released)"
        )
        level_rounding: Literal["floor", "round"] = Field(
            default="floor", description="of the level a camera asks for; floor: paper; round: released code"
        )
        anchor: Literal["center", "corner"] = Field(
            default="center", description="place of an anchor in its cell; center: paper; corner: released code"
        )
        color: Literal["mean", "max"] = Field(
            default="mean", description="colour of a cell from its points; mean: gsstream's own; max: released code"
        )
        unit: Literal["cell", "root"] = Field(
            default="cell",
            description="what position residuals, and so their rates, are measured in; cell: a cell of the Gaussian's "
            "own level (paper); root: a root cell for all, so that fine levels travel as far as coarse ones",
        )
        padding: float = Field(
            default=0.05, ge=0, le=10, description="margin around the points, fraction of their extent, 0 to 10"
        )
        gate_level: int = Field(
            default=0, ge=0, le=20, description="level at which Gaussians share a gate, 0 (root regions, paper) to 20"
        )
        grouping: Literal["cell", "gaussian"] = Field(
            default="cell", description="cell: one gate per cell; gaussian: one gate each (the ablation without HFP)"
        )

        @model_validator(mode="after")
        def _fits_in_a_key(self) -> StreamingOctree.Config:
            if self.root_exponent + self.max_levels - 1 > morton.AXIS_BITS:
                raise ValueError(
                    f"root_exponent + max_levels: expected at most {morton.AXIS_BITS + 1} (cells are numbered with "
                    f"{morton.AXIS_BITS} bits per axis), got {self.root_exponent} + {self.max_levels}; lower either"
                )
            return self

    traits = StructureTraits(idempotent=True, local=True)
    grouping_settings = frozenset({"gate_level", "grouping"})

    def seed(self, points: PointCloud, cameras: Cameras) -> Anchors:
        """Anchors of [P] points seen by the training cameras, sorted by level, then along a Morton curve.

        Raises InputError without points or cameras, ShapeError for coordinates that are not finite.
        """
        xyz, rgb = _checked(points, cameras)
        centers = torch.as_tensor(cameras.centers, dtype=torch.float64)
        far, near = _distance_range(xyz, centers, self.config.distance_quantile)
        levels = self._num_levels(far, near)
        origin, side = self._cube(xyz, far)
        finest = _cells(xyz, origin, side / 2.0 ** (self.config.root_exponent + levels - 1))
        # Points on the cube's upper faces (padding 0) belong to the last cell.
        keys = morton.encode(finest.clamp(0, 2 ** (self.config.root_exponent + levels - 1) - 1))
        positions, colors, level_of = [], [], []
        for level in range(levels):
            cell = side / 2.0 ** (self.config.root_exponent + level)
            unique, index = torch.unique(keys >> 3 * (levels - 1 - level), return_inverse=True)
            shift = 0.5 if self.config.anchor == "center" else 0.0
            where = origin + (morton.decode(unique) + shift) * cell
            keep = self._wanted(where, centers, level, levels=levels, far=far)
            positions.append(where[keep])
            colors.append(_cell_colors(rgb, index, len(unique), self.config.color)[keep])
            level_of.append(torch.full((int(keep.sum()),), level))
        depth = torch.arange(levels, dtype=torch.float64) if self.config.unit == "cell" else torch.zeros(levels)
        sizes = side / 2.0 ** (self.config.root_exponent + depth.double())
        anchors = Anchors(
            positions=torch.cat(positions).float(),
            colors=torch.cat(colors).float(),
            levels=torch.cat(level_of),
            cell_sizes=sizes.float(),
            origin=origin.float(),
        )
        check_finite("cell_sizes", anchors.cell_sizes)
        if float(anchors.cell_sizes[-1]) <= 0:
            raise InputError(f"points span {side:g} scene units: cells vanish in float32; rescale the scene")
        return anchors

    def build(self, gaussians: Gaussians[torch.Tensor], anchors: Anchors) -> Hierarchy:
        """Group Gaussians by the cell of their centre. Raises ShapeError when a centre is not finite."""
        means = gaussians.means.detach()
        check_shape("means", means, ("N", 3))
        check_finite("means", means)
        cell = float(anchors.cell_sizes[0]) / 2.0**self.config.gate_level
        cells = _cells(means.double(), anchors.origin.double(), cell).clamp(-FAR_CELLS, FAR_CELLS - 1) + FAR_CELLS
        keys = morton.encode(cells)
        if self.config.grouping == "gaussian":
            return _one_each(torch.argsort(keys, stable=True))
        return _forest(keys, self.config.gate_level)

    def _num_levels(self, far: float, near: float) -> int:
        """H of step 1. A point at a camera (near = 0) asks for infinitely many levels and gets the most allowed."""
        if far <= 0:
            return 1
        if near <= 0:
            return self.config.max_levels
        wanted = round((math.log(far) - math.log(near)) / math.log(self.config.log_base)) + 1
        return min(self.config.max_levels, wanted)

    def _cube(self, xyz: torch.Tensor, far: float) -> tuple[torch.Tensor, float]:
        """Lower corner [3] and side of the root cube, both exact in float32 so that ``build`` sees the same grid."""
        low, high = xyz.amin(0), xyz.amax(0)
        extent = float((high - low).max())
        # Coincident points have no extent of their own: the distance to the cameras is the only scale there is.
        extent = extent if extent > 0 else (far if far > 0 else 1.0)
        side = extent * (1 + 2 * self.config.padding)
        if not side < torch.finfo(torch.float32).max:
            raise InputError(f"points span {extent:g} scene units: its cube leaves float32; rescale the scene")
        origin = (low + high) / 2 - side / 2
        return origin.float().double(), float(np.float32(side))

    def _wanted(
        self, positions: torch.Tensor, centers: torch.Tensor, level: int, levels: int, far: float
    ) -> torch.Tensor:
        """[n] bool: the anchors of one level that enough cameras ask for (step 4)."""
        if level == 0:
            return torch.ones(len(positions), dtype=torch.bool)
        votes = torch.zeros(len(positions), dtype=torch.int64)
        for center in centers:
            distance = (positions - center).norm(dim=1)
            # Distance 0 gives log(inf) = inf, the finest level after the clamp; it is never converted before it.
            asked = torch.log(far / distance) / math.log(self.config.log_base)
            asked = torch.floor(asked) if self.config.level_rounding == "floor" else torch.round(asked)
            votes += level <= asked.clamp(0, levels - 1)
        threshold = self.config.visible_threshold * len(centers)
        return votes > threshold


def _checked(points: PointCloud, cameras: Cameras) -> tuple[torch.Tensor, torch.Tensor]:
    if len(points) == 0:
        raise InputError("no points to start from: expected at least 1, got 0; give points or enable seeding")
    if len(cameras) == 0:
        raise InputError("no training cameras: the octree chooses its levels by their distances; expected at least 1")
    check_shape("points.xyz", points.xyz, ("P", 3))
    check_shape("points.rgb", points.rgb, (len(points), 3))
    check_finite("points.xyz", points.xyz)
    check_finite("points.rgb", points.rgb)
    return torch.as_tensor(points.xyz, dtype=torch.float64), torch.as_tensor(points.rgb, dtype=torch.float64)


def _distance_range(xyz: torch.Tensor, centers: torch.Tensor, quantile: float) -> tuple[float, float]:
    """D_max and D_min of step 1, scene units."""
    per_camera = []
    for center in centers:
        distance = (xyz - center).norm(dim=1).numpy()
        per_camera.extend(np.quantile(distance, [1 - quantile, quantile]))
    near, far = np.quantile(per_camera, [1 - quantile, quantile])
    return float(far), float(near)


def _cells(positions: torch.Tensor, origin: torch.Tensor, cell: float) -> torch.Tensor:
    """[N, 3] int64 cell of each position. Cells are limited to the range to which callers clamp them, so that int64
    does not overflow."""
    limit = 4.0 * FAR_CELLS
    return torch.floor((positions - origin) / cell).clamp(-limit, limit).long()


def _cell_colors(rgb: torch.Tensor, index: torch.Tensor, cells: int, how: str) -> torch.Tensor:
    """[cells, 3] mean or maximum of the points' colours."""
    target = rgb.new_zeros(cells, 3)
    reduce = "mean" if how == "mean" else "amax"
    return target.scatter_reduce(0, index[:, None].expand(-1, 3), rgb, reduce=reduce, include_self=False)


def _forest(keys: torch.Tensor, depth: int) -> Hierarchy:
    """The occupied cells of ``depth`` + 1 levels, coarsest level first, each level in Morton order."""
    per_level = [torch.unique(keys >> 3 * (depth - level)) for level in range(depth + 1)]
    offsets = [0]
    for nodes in per_level:
        offsets.append(offsets[-1] + len(nodes))
    parent = [torch.arange(len(per_level[0]), device=keys.device)]
    parent += [
        offsets[level - 1] + torch.searchsorted(per_level[level - 1], per_level[level] >> 3)
        for level in range(1, depth + 1)
    ]
    level_of = [torch.full((len(nodes),), level, device=keys.device) for level, nodes in enumerate(per_level)]
    node_of = offsets[depth] + torch.searchsorted(per_level[depth], keys)
    return Hierarchy(node_of, torch.cat(parent), torch.cat(level_of))


def _one_each(order: torch.Tensor) -> Hierarchy:
    """One root node per Gaussian; node j holds Gaussian ``order[j]``."""
    index = torch.arange(len(order), device=order.device)
    node_of = torch.empty_like(order)
    node_of[order] = index
    return Hierarchy(node_of, index, torch.zeros_like(index))
