"""What renderers return: views, what a session keeps, and views that were judged and differentiated, too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from gsstream.core.gaussians import Gaussians

TILE = 16


@dataclass(frozen=True, slots=True)
class RenderOutput:
    """One rendered view.

    Arguments:
        image: [H, W, 3] composited colour; with a tile mask only active tiles are defined (others hold the cached
            render in a session, the background elsewhere).
        alpha: [H, W] 1 - transmittance.
        tiles: [ceil(H / 16), ceil(W / 16)] bool, in a session: the tiles that the active rows are in, now or as the
            session was opened. All others hold the same image in every render of the session. None: any may differ.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    tiles: torch.Tensor | None = None


@dataclass(frozen=True, slots=True)
class RenderCache:
    """Memory a session keeps for its cameras.

    Arguments:
        per_view: bytes of each view that is cached, scratch and images included; views drawn anew each time are absent.
        gaussians: N of the scene.
    """

    per_view: Mapping[int, int] = field(default_factory=dict)
    gaussians: int = 0

    @property
    def total(self) -> int:
        """Bytes of all views."""
        return sum(self.per_view.values())

    @property
    def per_camera_and_gaussian(self) -> float:
        """Bytes per cached camera and Gaussian; 0 where nothing is cached."""
        count = len(self.per_view) * self.gaussians
        return self.total / count if count else 0.0


@dataclass(frozen=True, slots=True)
class Comparison:
    """What a render of one view is compared with.

    Arguments:
        loss: the photometric loss (a part, without its guard).
        target: what its ``prepare`` made of the image that the camera recorded.
        dssim: weight of 1 - SSIM, 0 to 1.
        matrix, offset: [3, 3] and [3] colour map of the camera, recorded = matrix scene + offset; or both None.
        tiles: [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles; a tile of 0 is left out, and
            shows the session's scene as it was. None: every tile counts once.
    """

    loss: object
    target: Any
    dssim: float
    matrix: torch.Tensor | None = None
    offset: torch.Tensor | None = None
    tiles: torch.Tensor | None = None


class Pulled(NamedTuple):
    """Loss of a view, and its gradient by the rows that were rendered."""

    loss: float
    gradients: Gaussians[torch.Tensor]


class WholePull(NamedTuple):
    """Loss of a view, and its gradient by all that frame 0 fits; whoever gets it may change it.

    Arguments:
        loss: of the view.
        gradients: by the N rows of the scene.
        means2d: [N, 2] by the 2-D means, pixels; None where nobody asked for it.
        colours: [12] by the camera's colour map, its matrix [3, 3] row by row and its offset [3]; None without a map.
    """

    loss: float
    gradients: Gaussians[torch.Tensor]
    means2d: torch.Tensor | None
    colours: torch.Tensor | None
