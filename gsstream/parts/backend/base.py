"""Renderer: Gaussians and one camera in, an image and gradients out; and what else is computed where it works.

A renderer brings the loss and the row optimiser that work beside it, and finds what changed in images. They are no
parts of their own, because all implementations give the same numbers and only those that know each other are fast
together. The defaults are the reference ones, in torch on any device: a renderer that only draws is complete.

Conventions: pixel-corner origin, 0.3 px screen-space blur, alpha cut at 1/255, alpha clamped at 0.999, a Gaussian
counts while the transmittance before it exceeds 1e-4, near plane ``cameras.near_plane``. Tiles are 16 x 16 pixels.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.render.drawn import drawn_rows
from gsstream.parts.render.loss import Loss, ReferenceLoss
from gsstream.parts.render.session import RenderOutput, RenderSession


class Renderer(Part):
    """A differentiable rasteriser. What it returns lies on the device of what it is given."""

    @property
    def device(self) -> torch.device:
        """Where it works fastest; the engine keeps its scene, targets and gradients there."""
        return torch.device("cpu")

    @property
    def loss(self) -> Loss:
        """What renders are compared by: the one loss of every target that a session of this renderer is given."""
        return ReferenceLoss()

    @property
    def optimiser(self) -> RowOptimiser:
        """What moves rows: its residual optimisers are given sessions of this renderer and no others."""
        return ReferenceAdam()

    def find_change(self, before: Sequence[torch.Tensor], now: Sequence[torch.Tensor], threshold: float) -> Change:
        """Say which tiles of which views changed. Another body finds the same tiles, bit for bit.

        Arguments:
            before, now: one image [H, W, 3] per view where the renderer works, float32, or uint8 of which 255 is 1.0.
            threshold: multiple of the noise of the means of 4 x 4 pixels, above 0.
        """
        return find_change(before, now, threshold)

    @abstractmethod
    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: tuple[float, float, float]
    ) -> RenderOutput:
        """Render one camera of the rig; differentiable in every attribute.

        Arguments:
            gaussians: N rows, raw values. cameras: the rig.
            view: index of one of its cameras. background: colour behind everything, 0 to 1.
        """

    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        """Backpropagate an upstream image gradient [H, W, 3] to the 2-D means (pixels) of a scene on black.

        By default a session is asked. A renderer that opens a ``ScatterSession`` overrides this method: that session
        asks its renderer.

        Arguments:
            gaussians: N rows, raw values. cameras: the rig.
            view: index of one of its cameras. image_gradient: [H, W, 3].

        Raises:
            NotImplementedError: neither the renderer nor its session knows the gradient of the 2-D means.
        """
        session = self.open(gaussians, None, cameras, (0.0, 0.0, 0.0))
        if type(session).screen_gradient is ScatterSession.screen_gradient:
            name = type(self).__name__
            raise NotImplementedError(
                f"{name}: expected 'screen_gradient', or an 'open' whose session has its own, got neither; write one"
            )
        return session.screen_gradient(view, image_gradient)

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> RenderSession:
        """Open a session in which only the rows ``active`` [A] (None: all) change. Renderers may cache the rest.

        Arguments:
            gaussians: N rows, raw values. active: [A] rows that change, ascending; None: all.
            cameras: the rig. background: colour behind everything, 0 to 1.
        """
        return ScatterSession(renderer=self, gaussians=gaussians, active=active, cameras=cameras, background=background)


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

    @property
    def cameras(self) -> Cameras:
        return self._cameras

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
        return self._renderer.render(self._whole(rows), self._cameras, view, self._background)

    def _whole(self, rows: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
        """The session's scene with the active rows put into their places."""
        if self._active is None:
            return rows
        base = dict(self._gaussians.items())
        return Gaussians(**{n: base[n].index_copy(0, self._active, value) for n, value in rows.items()})

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return self._renderer.screen_gradient(self._gaussians, self._cameras, view, image_gradient)

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        size = self._cameras.height, self._cameras.width
        scene = self._gaussians
        return drawn_rows(lambda g: self._renderer.render(g, self._cameras, view, (0.0,) * 3), scene, size, tiles)

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        return self._renderer.open(gaussians, None, self._cameras, self._background)
