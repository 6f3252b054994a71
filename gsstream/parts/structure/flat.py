"""Flat structure: each Gaussian is its own node."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, final

import torch
from pydantic import Field

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import PartConfig
from gsstream.core.shapes import check_finite
from gsstream.parts.structure.base import Anchors, Structure, StructureTraits


@final
class Flat(Structure):
    """No grouping: M = N, and every node is a root. Anchors are the points themselves."""

    source = "gsstream"

    class Config(PartConfig):
        resolution: int = Field(
            default=1024,
            ge=1,
            le=65536,
            description="position residuals are measured in (the length named by unit / resolution); 1 to 65536",
        )
        unit: Literal["points", "rig"] = Field(
            default="points", description="points: diameter of the scene's points; rig: extent of the training cameras"
        )

    traits = StructureTraits(idempotent=True, local=True, has_grid=False)

    def claims(self) -> StructureTraits:
        return replace(self.traits, has_grid=self.config.unit == "rig")

    def seed(self, points: PointCloud, cameras: Cameras) -> Anchors:
        if len(points) == 0:
            raise InputError("no points to start from: expected at least 1, got 0; do the cameras have a common view?")
        check_finite("points.xyz", points.xyz)
        check_finite("points.rgb", points.rgb)
        positions = torch.as_tensor(points.xyz, dtype=torch.float32)
        span = positions.amax(0) - positions.amin(0)
        length = float(span.norm()) if self.config.unit == "points" else cameras.extent
        unit = length / self.config.resolution
        return Anchors(
            positions=positions,
            colors=torch.as_tensor(points.rgb, dtype=torch.float32),
            levels=torch.zeros(len(positions), dtype=torch.int64),
            cell_sizes=torch.tensor([unit if unit > 0 else 1.0]),
            origin=positions.amin(0),
        )

    def build(self, gaussians: Gaussians[torch.Tensor], anchors: Anchors) -> Hierarchy:
        index = torch.arange(len(gaussians))
        return Hierarchy(node_of=index, parent=index, level=torch.zeros_like(index))
