"""The frame context that confidence estimators see."""

from __future__ import annotations

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.storage import unpacked
from gsstream.engine.step.active.change import MOST_PIXEL_SIGMA, Change
from gsstream.engine.state.stream_state import StreamState
from gsstream.metrics.noise import noise_sigma
from gsstream.render.base import Renderer, RenderSession


class StepContext:
    """Read-only view of one frame step (implements ``gsstream.core.context.FrameContext``).

    Images are as recorded; gradients are pulled through the camera's colour map, so that estimators need not know it.
    """

    def __init__(
        self,
        state: StreamState,
        frame: Frame,
        renderer: Renderer,
        background: tuple[float, float, float],
        change: Change | None = None,
    ) -> None:
        self._state, self._frame, self._renderer, self._background = state, frame, renderer, background
        self._change = change
        self._gaussians = state.gaussians
        #: What the last frame or an estimator made the renderer project and sort is not done again.
        self.session = state.session or renderer.open(self._gaussians, None, frame.cameras, background)
        self._touched: dict[int, torch.Tensor] = {}

    def session_for(self, active: torch.Tensor) -> RenderSession:
        """The session in which only the rows ``active`` change. When all do, no cache is of use: a new one."""
        if len(active) == len(self._gaussians):
            return self._renderer.open(self._gaussians, None, self.cameras, self._background)
        self.session.narrow(active)
        return self.session

    @property
    def index(self) -> int:
        return self._frame.index

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        return self._gaussians

    @property
    def hierarchy(self) -> Hierarchy:
        return self._state.hierarchy

    @property
    def cameras(self) -> Cameras:
        return self._frame.cameras

    def image(self, view: int) -> torch.Tensor:
        return torch.from_numpy(self._frame.images[view])

    def previous_image(self, view: int) -> torch.Tensor:
        return torch.from_numpy(unpacked(self._state.previous.images[view]))

    def previous_render(self, view: int) -> torch.Tensor:
        with torch.no_grad():
            image = self._renderer.render(self._gaussians, self.cameras, view, self._background).image
        return self._state.exposure.apply(view, image) if self._state.exposure else image

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        upstream = image_gradient.float()
        if self._change is not None:
            if not bool(self._change.tiles[view].any()):
                nothing = torch.zeros(len(self._gaussians), dtype=torch.bool)
                self._touched.setdefault(view, nothing)
                return ScreenGradient(torch.zeros(len(nothing), 2), nothing)
            upstream = upstream * self._change.pixels(view)
        if self._state.exposure:
            upstream = self._state.exposure.pull(view, upstream)
        result = self.session.screen_gradient(view, upstream.contiguous())
        self._touched.setdefault(view, (result.gradient != 0).any(1))
        return result

    def suspects(self, least_votes: float) -> torch.Tensor:
        """[N] bool: Gaussians visible in a changed tile of some view, with at least this share of votes.

        All of them when change is not detected.

        Views that the estimator already differentiated cost nothing here: what it got back shows whom they touch.
        """
        everyone = torch.ones(len(self._gaussians), dtype=torch.bool)
        if self._change is None:
            return everyone
        for view in range(len(self.cameras)):
            if view not in self._touched:
                self.screen_gradient(view, torch.ones_like(self.image(view)))
        touched = torch.stack(list(self._touched.values())).any(0) if self._touched else ~everyone
        rows = touched.nonzero()[:, 0]
        touched[rows] = self._change.votes(self._gaussians.means[rows], self.cameras) >= least_votes
        return touched

    def noise_sigma(self, view: int) -> float:
        # Where everything moves, the estimate is the change itself; see MOST_SIGMA.
        measured = noise_sigma(unpacked(self._state.previous.images[view]), self._frame.images[view])
        return min(measured, MOST_PIXEL_SIGMA)
