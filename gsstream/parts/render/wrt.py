"""With respect to what a view's loss is differentiated, and the result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Generic, TypeVar, final

import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.backward import gradient_of
from gsstream.parts.render.transforms import transform_rows, transform_vjp

G = TypeVar("G")

#: Opacity logit of a Gaussian that is left out of a pass: an alpha far below 1/255, which no renderer draws.
NEVER_DRAWN = -30.0


class Wrt(ABC, Generic[G]):
    """What is rendered, and what the loss is differentiated by. Closed: rows, transforms of groups, a whole scene."""

    __slots__ = ()

    @property
    def means2d(self) -> bool:
        """Whether the gradient by the 2-D means is asked for, too."""
        return False

    @property
    def exposure(self) -> bool:
        """Whether the gradient by the target's colour map is asked for, too."""
        return False

    @abstractmethod
    def placed(self) -> Gaussians[torch.Tensor]:
        """Return the rows that are rendered."""

    @abstractmethod
    def grad(self, leaves: Gaussians[torch.Tensor]) -> G:
        """Return the gradient, from that which the rendered rows have in their ``grad``."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class WrtRows(Wrt[Gaussians[torch.Tensor]]):
    """By the A active rows of a session, raw values; all N of one that was not narrowed. No graph is looked at."""

    values: Gaussians[torch.Tensor]
    means2d: bool = False

    def placed(self) -> Gaussians[torch.Tensor]:
        return self.values

    def grad(self, leaves: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
        return leaves.map(gradient_of)


@final
@dataclass(frozen=True, slots=True, eq=False)
class WrtTransforms(Wrt[torch.Tensor]):
    """By shift and turn of groups of the active rows.

    Arguments:
        base: the A rows before they move, raw values.
        transforms: of these rows, which it counts from 0 to A - 1.
        curvature: return the curvature, too.
    """

    base: Gaussians[torch.Tensor]
    transforms: GroupTransforms[torch.Tensor]
    curvature: bool = False

    def placed(self) -> Gaussians[torch.Tensor]:
        """Return the rows after they moved."""
        return transform_rows(self.base, self.transforms)

    def grad(self, leaves: Gaussians[torch.Tensor]) -> torch.Tensor:
        return transform_vjp(leaves, self.transforms)


@final
@dataclass(frozen=True, slots=True, eq=False)
class WrtScene(Wrt[Gaussians[torch.Tensor]]):
    """By all N rows of a session that was not narrowed, and by what frame 0 fits besides.

    Arguments:
        values: N rows, raw values.
        means2d, exposure: ask for these gradients, too.
        keep: [N] bool, rows that are drawn; None: all. The gradient of the others is 0.
    """

    values: Gaussians[torch.Tensor]
    means2d: bool = True
    exposure: bool = True
    keep: torch.Tensor | None = None

    def placed(self) -> Gaussians[torch.Tensor]:
        if self.keep is None:
            return self.values
        return replace(self.values, opacities=torch.where(self.keep, self.values.opacities, NEVER_DRAWN))

    def grad(self, leaves: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
        return leaves.map(gradient_of)


@final
@dataclass(frozen=True, slots=True, eq=False)
class LossAndGrad(Generic[G]):
    """Loss of a view and its gradients. The caller owns the tensors and may change them.

    Arguments:
        loss: [] of the tiles that the rows can change.
        grad: like the rows; of transforms [K, 6] float64 by shift [per scene unit] and turn [per tan(angle / 2)].
        curvature: [K, 6, 6] float64 of transforms: how fast ``grad`` grows where a group moves on, a symmetric block
            each (``gsstream.parts.render.transforms``).
        means2d: [rows, 2] by the 2-D means, pixels.
        exposure: [12] by the camera's colour map, its matrix [3, 3] row by row and its offset [3].

    The last three are None where they were not asked for; ``exposure`` also where the target has no colour map.
    """

    loss: torch.Tensor
    grad: G
    curvature: torch.Tensor | None = None
    means2d: torch.Tensor | None = None
    exposure: torch.Tensor | None = None
