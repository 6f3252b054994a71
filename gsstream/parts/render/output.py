"""What renderers return: views, and what a session keeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

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
