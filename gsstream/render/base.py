"""Renderer: Gaussians and one camera in, an image and gradients out.

Conventions: pixel-corner origin, 0.3 px screen-space blur, alpha cut at 1/255, alpha clamped at 0.999, a Gaussian
counts while the transmittance before it exceeds 1e-4, near plane ``cameras.near``. Tiles are 16 x 16 pixels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part

TILE = 16


@dataclass(frozen=True, slots=True)
class RenderOutput:
    """One rendered view.

    Arguments:
        image: [H, W, 3] composited colour; with a tile mask only active tiles are defined (others hold the cached
            render in a session, the background elsewhere).
        alpha: [H, W] 1 - transmittance.
    """

    image: torch.Tensor
    alpha: torch.Tensor


class RenderSession(ABC):
    """Renders a scene of which only some rows change, from a fixed rig (one frame step).

    ``rows`` are the A active rows; all other Gaussians stay as they were when the session was opened.
    """

    @abstractmethod
    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        """Differentiable render of camera ``view``.

        Arguments:
            rows: the A active rows, raw parameters.
            probe: [A, 2] zeros that require grad; its gradient is the gradient of the 2-D means in pixels.
            tile_mask: [ceil(H / 16), ceil(W / 16)] bool; None renders everything.
        """

    @abstractmethod
    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """Pull an upstream image gradient [H, W, 3] back to the 2-D means (pixels) of the scene as it was opened.

        What this projects and sorts, ``render`` need not do again.
        """

    @abstractmethod
    def narrow(self, active: torch.Tensor) -> None:
        """From now on only the rows ``active`` [A], ascending, change. For a session opened without active rows."""


class Renderer(Part):
    """A differentiable rasteriser."""

    @abstractmethod
    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: tuple[float, float, float]
    ) -> RenderOutput:
        """Render one camera of the rig; differentiable in every attribute."""

    @abstractmethod
    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        """Pull an upstream image gradient [H, W, 3] back to the 2-D means (pixels)."""

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> RenderSession:
        """Open a session in which only the rows ``active`` [A] (None: all) change. Renderers may cache the rest."""
        return ScatterSession(self, gaussians, active, cameras, background)


class ScatterSession(RenderSession):
    """The session every renderer has: put the active rows back and render everything."""

    def __init__(
        self,
        renderer: Renderer,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> None:
        self._renderer, self._gaussians, self._active = renderer, gaussians, active
        self._cameras, self._background = cameras, background

    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        if probe is not None:
            name = type(self._renderer).__name__
            raise NotImplementedError(f"{name} offers no gradient of the 2-D means in a session")
        whole = rows
        if self._active is not None:
            base = dict(self._gaussians.items())
            whole = Gaussians(**{n: base[n].index_copy(0, self._active, value) for n, value in rows.items()})
        return self._renderer.render(whole, self._cameras, view, self._background)

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return self._renderer.screen_gradient(self._gaussians, self._cameras, view, image_gradient)

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active
