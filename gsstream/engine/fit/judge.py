"""How a rendered view is judged: as its camera would have recorded it, against what it did record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.guard import plain
from gsstream.engine.fit.backward import gradient_of, pull_back
from gsstream.engine.fit.exposure import Exposure, colour_slope
from gsstream.loss.base import Loss
from gsstream.render.base import TILE, Comparison, Pulled, Renderer, RenderSession, WholePull
from gsstream.render.structure import weighed_structure


class Judge:
    """Compares renders of one frame with its images.

    Arguments:
        loss: the photometric loss; dssim: its weight of 1 - SSIM.
        images: [V, H, W, 3] what the cameras recorded. What the loss makes of an image is made when it is first needed.
        exposure: colour maps of the cameras, or None.
        in_one_go: let a session render, judge and differentiate in one call, where it can.
    """

    def __init__(
        self, loss: Loss, dssim: float, images: FloatArray, exposure: Exposure | None, in_one_go: bool = False
    ) -> None:
        self._loss, self._dssim, self._images, self.exposure = loss, dssim, images, exposure
        self.in_one_go = in_one_go
        self._targets: dict[int, Any] = {}

    def pull(
        self, session: RenderSession, view: int, rows: Gaussians[torch.Tensor], tiles: torch.Tensor | None = None
    ) -> Pulled:
        """Render a view, judge it, and pull the loss back to the rows that were rendered.

        Arguments:
            session: renders the scene.
            view: index of a training camera.
            rows: the active rows of the session; a graph of theirs is left alone.
            tiles: [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles, 0: left out; None: all count.
        """
        if self.in_one_go:
            pulled = session.pull(view, rows, self.comparison(view, tiles))
            if pulled is not None:
                return pulled
        leaves = rows.map(lambda value: value.detach().requires_grad_())
        counted = None if tiles is None else tiles > 0
        output = session.render(view, leaves, tile_mask=counted)
        touched = output.tiles
        if counted is not None:
            touched = counted if touched is None else counted & touched
        loss, _ = self.backward(view, output.image, touched, tiles)
        return Pulled(loss, leaves.map(gradient_of))

    def pull_whole(
        self, session: RenderSession, view: int, rows: Gaussians[torch.Tensor], probed: bool = True
    ) -> WholePull:
        """Render a view of a scene of which every row moves, judge it, and pull the loss back to all that frame 0 fits.

        Arguments:
            session: renders the scene; not narrowed.
            view: index of a training camera.
            rows: all N rows; a graph of theirs is left alone.
            probed: whether the gradient by the 2-D means is needed, too.
        """
        if self.in_one_go:
            pulled = session.pull_whole(view, rows, self.comparison(view))
            if pulled is not None:
                return pulled
        leaves = rows.map(lambda value: value.detach().requires_grad_())
        probe = torch.zeros(len(rows), 2, requires_grad=True) if probed else None
        image = session.render(view, leaves, probe=probe).image
        loss, gradient = self.backward(view, image)
        colours = colour_slope(image.detach(), gradient) if self.exposure else None
        return WholePull(loss, leaves.map(gradient_of), None if probe is None else gradient_of(probe), colours)

    def structure(
        self, session: RenderSession, view: int, rows: Gaussians[torch.Tensor], tiles: torch.Tensor | None = None
    ) -> FloatArray:
        """Return [A, 3]: sums over pixels of the share that a row has of a pixel's light, times structure there.

        Arguments:
            session, view, rows, tiles: as for :meth:`pull`.
        """
        rows = rows.map(torch.Tensor.detach)
        colour = rows.sh0.clone().requires_grad_()
        output = session.render(view, replace(rows, sh0=colour), tile_mask=None if tiles is None else tiles > 0)
        recorded = self.recorded(view, output.image.detach())
        # The gradient of a pixel by a colour is the share that its Gaussian has of the pixel's light.
        pull_back([output.image], [weighed_structure(recorded, torch.from_numpy(self._images[view]))])
        shares = gradient_of(colour)[:, 0].numpy() / SH0
        return np.asarray(shares)

    def comparison(self, view: int, tiles: torch.Tensor | None = None) -> Comparison:
        """Return what renders of a view are compared with.

        Arguments:
            view: index of a training camera.
            tiles: as for :meth:`pull`.
        """
        exposure = self.exposure
        matrix, offset = (exposure.matrix[view], exposure.offset[view]) if exposure else (None, None)
        return Comparison(plain(self._loss), self._target(view), self._dssim, matrix, offset, tiles)

    def backward(
        self, view: int, image: torch.Tensor, tiles: torch.Tensor | None = None, weights: torch.Tensor | None = None
    ) -> tuple[float, torch.Tensor]:
        """Judge a render and pull the loss back into whatever it was rendered from.

        Arguments:
            view: index of a training camera.
            image: [H, W, 3] scene colours, with a graph.
            tiles: the only tiles that what is optimised can change (``RenderOutput.tiles``); None: all.
            weights: [ceil(H / 16), ceil(W / 16)] factors on the gradients of tiles; None: 1.

        Returns:
            The loss, and its gradient [H, W, 3] with respect to the recorded colours.
        """
        recorded = self.recorded(view, image.detach())
        value, gradient = self._loss.evaluate(recorded, self._target(view), self._dssim, tiles)
        if weights is not None:
            height, width = image.shape[:2]
            per_pixel = weights.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]
            gradient = gradient * per_pixel[..., None]
        pull_back([image], [self.exposure.pull(view, gradient) if self.exposure else gradient])
        return value, gradient

    def _target(self, view: int) -> Any:
        if view not in self._targets:
            self._targets[view] = self._loss.prepare(torch.from_numpy(self._images[view]))
        return self._targets[view]

    def recorded(self, view: int, image: torch.Tensor) -> torch.Tensor:
        """Return [H, W, 3] scene colours as the camera of this view records them."""
        return self.exposure.apply(view, image) if self.exposure else image


def shown(
    renderer: Renderer, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int,
    background: tuple[float, float, float], exposure: Exposure | None,
) -> torch.Tensor:  # fmt: skip
    """Return [H, W, 3]: a scene as the camera of this view records it; no graph.

    Arguments:
        renderer: that draws.
        gaussians: N rows, raw values.
        cameras: training cameras.
        view: index of one of them.
        background: colour behind everything, 0 to 1.
        exposure: colour maps of the cameras, or None.
    """
    with torch.no_grad():
        image = renderer.render(gaussians, cameras, view, background).image
    return exposure.apply(view, image) if exposure else image
