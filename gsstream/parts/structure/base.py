"""Structure: place anchors and group Gaussians into a Hierarchy."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import Part, Traits


@dataclass(frozen=True)
class Anchors:
    """Where Gaussians start.

    Arguments:
        positions: [N, 3] float32, scene units.
        colors: [N, 3] float32 in [0, 1].
        levels: [N] int64 octree level of each anchor, 0 = coarsest.
        cell_sizes: [levels] float32 side of a cell per level, scene units; position residuals are measured in it.
        origin: [3] float32 lower corner of the root grid.
    """

    positions: torch.Tensor
    colors: torch.Tensor
    levels: torch.Tensor
    cell_sizes: torch.Tensor
    origin: torch.Tensor


@dataclass(frozen=True, slots=True)
class StructureTraits(Traits):
    """What a structure claims.

    Arguments:
        idempotent: building again from the same Gaussians, also stored node by node, gives the same forest.
        local: the members of a node lie within one root cell of each other, along every axis.
        has_grid: its groups follow a grid that it lays when it seeds; False: any grid serves it, as units of position.
    """

    idempotent: bool = False
    local: bool = False
    has_grid: bool = True


class Structure(Part):
    """Groups Gaussians; gates live on the nodes of the hierarchy it builds.

    Invariants (checked by the contract kit): ``node_of`` in [0, M); parents end at a root; the same Gaussians give the
    same partition whatever their order; no gradient is carried.
    """

    traits: ClassVar[StructureTraits] = StructureTraits()
    #: Settings of ``Config`` that decide how Gaussians are grouped on the grid; all others decide the grid itself. A
    #: stream that takes over a frame 0 keeps its grid where the structure that laid it differs in none of the others.
    grouping_settings: ClassVar[frozenset[str]] = frozenset()

    def claims(self) -> StructureTraits:
        return self.traits

    @abstractmethod
    def seed(self, points: PointCloud, cameras: Cameras) -> Anchors:
        """Choose anchors for the first frame from [P] points. Raises InputError when there are no points."""

    @abstractmethod
    def build(self, gaussians: Gaussians[torch.Tensor], anchors: Anchors) -> Hierarchy:
        """Group the Gaussians (rows aligned with ``anchors.levels``).

        The engine asks for this at frame 0 and wherever a stream is taken up again; after rows were added and removed
        in between it keeps the groups and gives new Gaussians the node that the packet says (``core.changes.rows``).
        """
