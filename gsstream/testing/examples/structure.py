"""Boxes: Gaussians of one cell of a regular grid share a gate."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

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
)


@final
class ExampleStructure(Structure):
    """A regular grid with ``cells`` cells along the longest side; every node is a root."""

    source = "gsstream"

    class Config(PartConfig):
        cells: int = Field(default=32, ge=1, le=65536, description="cells along the longest side of the points")

    traits = StructureTraits(idempotent=True, local=True)

    def seed(self, points: PointCloud, cameras: Cameras) -> Anchors:
        if len(points) == 0:
            raise InputError("no points to start from: expected at least 1, got 0; give points or enable seeding")
        positions = torch.as_tensor(points.xyz, dtype=torch.float32)
        check_finite("points.xyz", positions)
        check_finite("points.rgb", points.rgb)
        side = float((positions.amax(0) - positions.amin(0)).max())
        return Anchors(
            positions=positions,
            colors=torch.as_tensor(points.rgb, dtype=torch.float32),
            levels=torch.zeros(len(positions), dtype=torch.int64),
            cell_sizes=torch.tensor([side / self.config.cells if side > 0 else 1.0]),
            origin=positions.amin(0),
        )

    def build(self, gaussians: Gaussians[torch.Tensor], anchors: Anchors) -> Hierarchy:
        means = gaussians.means.detach()
        check_finite("means", means)
        cells = torch.floor((means.double() - anchors.origin.double()) / float(anchors.cell_sizes[0])).long()
        occupied, node_of = torch.unique(cells, dim=0, return_inverse=True)
        index = torch.arange(len(occupied))
        return Hierarchy(node_of, index, torch.zeros_like(index))
