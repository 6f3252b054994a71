"""One frame as parts and methods see it: images, what changed, gradients, and rendering with some rows moving."""

from __future__ import annotations

from copy import copy
from typing import Literal

import torch

from gsstream.core.context import RowGradient, ScreenGradient
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.log import FrameLog
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.constants import DSSIM
from gsstream.engine.fit.photometric import FrameImages, PhotometricLoss, render_exposed
from gsstream.engine.state.stream_state import Resident, StreamState
from gsstream.input.seeds.shell import in_shell
from gsstream.metrics.noise import noise_sigma
from gsstream.parts.backend.change import Change
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.render.session import RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.wrt import G, LossAndGrad, Wrt

#: Upper bound on the noise of one pixel of one image.
MAX_PIXEL_SIGMA = 16 / 255


class EngineContext:
    """One frame over a decoded scene (implements ``render.work.FitContext`` and ``method.tools.FrameTools``).

    Images are as recorded; gradients are backpropagated through the camera's colour map, so that parts need not know
    it. ``change`` is what changed since the images ``before``, None: everything counts as changed; without ``before``
    these are what the scene shows.
    """

    def __init__(
        self,
        assembly: Assembly,
        state: StreamState,
        frame: Frame,
        log: FrameLog,
        change: Change | None = None,
        before: FrameImages | None = None,
        part_scale: float = 1.0,
        images: FrameImages | None = None,
    ) -> None:
        self._assembly, device = assembly, assembly.renderer.device
        resident = state.resident
        if resident is None:
            gaussians = state.player.gaussians.map(lambda value: torch.from_numpy(value).to(device))
            resident = Resident(gaussians, state.hierarchy.to(device))
        self.gaussians, self.hierarchy = resident
        self.previous_images = state.pictures_on(device).shown if before is None else before
        self.index, self.cameras = frame.index, frame.cameras
        self._device, self._frame, self._change = device, frame, change
        self._previous, self._shell = state.previous, state.shell
        self._static = set() if change is None else {view for view, count in enumerate(change.per_view) if not count}
        self._background, self._part_scale = assembly.background, part_scale
        self.log = log
        self.key_rows = state.player.key_rows
        exposure = None if state.exposure is None else state.exposure.to(device)
        self.images = FrameImages(frame.images, device) if images is None else images
        self.photometric = PhotometricLoss(assembly.renderer.loss, DSSIM, self.images, exposure)
        self._session = state.session

    @property
    def session(self) -> RenderSession:
        """The render session of this scene, with what the last frame or a part has projected already."""
        if self._session is None:
            self._session = self._assembly.renderer.open(self.gaussians, None, self.cameras, self._background)
        return self._session

    def session_for(self, rows: torch.Tensor) -> RenderSession:
        """Return the session in which only ``rows`` change; a new one when all do, since no cache is of use then."""
        if len(rows) == len(self.gaussians):
            return self._assembly.renderer.open(self.gaussians, None, self.cameras, self._background)
        self.session.narrow(rows)
        return self.session

    def image(self, view: int) -> torch.Tensor:
        return self.images[view]

    def previous_image(self, view: int) -> torch.Tensor:
        return self.previous_images[view]

    def image_change(self, view: int) -> torch.Tensor:
        if self._change is None:
            return self.image(view) - self.previous_image(view)
        return self._change.difference(view, self.images.stored(view), self.previous_images.stored(view))

    def previous_render(self, view: int) -> torch.Tensor:
        return self.shown(self.gaussians, view)

    def shown(self, gaussians: Gaussians[torch.Tensor], view: int) -> torch.Tensor:
        renderer, exposure = self._assembly.renderer, self.photometric.exposure
        return render_exposed(
            renderer, gaussians, self.cameras, view=view, background=self._background, exposure=exposure
        )

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        if view in self._static:
            none = torch.zeros_like(self.gaussians.means[:, :2])
            return ScreenGradient(none, torch.zeros_like(none[:, 0], dtype=torch.bool))
        return self.session.screen_gradient(view, self._upstream(view, image_gradient))

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        if view in self._static:
            means = self.gaussians.means
            return RowGradient(means.new_zeros(0, dtype=torch.int64), means.new_zeros(0, 2))
        return self.session.screen_gradient_rows(view, self._upstream(view, image_gradient))

    def _upstream(self, view: int, image_gradient: torch.Tensor) -> torch.Tensor:
        """A gradient by what a camera records, in the tiles that changed, as one by the scene's colours."""
        upstream = image_gradient.float()
        if self._change is not None:
            upstream = self._change.only_changed(view, upstream)
        if self.photometric.exposure:
            upstream = self.photometric.exposure[view].vjp(upstream)
        return upstream.contiguous()

    def noise_sigma(self, view: int) -> float:
        # Where everything moves, the estimate measures the motion instead of the noise, so it is bounded.
        measured = noise_sigma(self._previous.image(view), self._frame.image(view))
        return min(measured, MAX_PIXEL_SIGMA)

    @property
    def optimiser(self) -> RowOptimiser:
        return self._assembly.renderer.optimiser

    def scaled(self, number: float) -> int:
        return max(1, round(number * self._frame.epoch_scale * self._part_scale))

    @property
    def shell_rows(self) -> torch.Tensor:
        if self._shell is None:
            return torch.zeros_like(self.gaussians.opacities, dtype=torch.bool)
        means, scales = self.gaussians.means.cpu().numpy(), self.gaussians.scales.cpu().numpy()
        return torch.from_numpy(in_shell(means, scales, self._shell)).to(self._device)

    def changed_rows(self, min_votes: float, min_votes_of_ends: float = 0.0) -> torch.Tensor:
        if self._change is None:
            return ~self.shell_rows
        able = self._change.rows(self.gaussians.means, self.cameras, self.session, min_votes) & ~self.shell_rows
        return self._change.within(able, self.gaussians, self.cameras, min_votes_of_ends) if min_votes_of_ends else able

    def narrow(self, rows: torch.Tensor) -> None:
        self._session = self.session_for(rows)

    def loss_and_grad(self, view: int, wrt: Wrt[G], tiles: Literal["all", "changed"] = "all") -> LossAndGrad[G]:
        target = self.view_target(view) if tiles == "all" else self.changed_target(view)
        return self.session.loss_and_grad(view, target, wrt)

    def view_target(self, view: int, tile_weights: torch.Tensor | None = None) -> ViewTarget:
        self._assembly.where.count()  # counts iterations: each iteration asks for one target
        return self.photometric.view_target(view, tile_weights)

    def changed_target(self, view: int, far: float = 0.0) -> ViewTarget:
        """Return what a render of this view is compared with in the tiles that changed, and in those beside them.

        All other tiles have the weight ``far``, 0 to 1.
        """
        if self._change is None or far == 1.0:
            return self.view_target(view)
        return self.view_target(view, self._change.dilated[view].float().clamp_min(far))

    def on(self, gaussians: Gaussians[torch.Tensor], session: RenderSession | None = None) -> EngineContext:
        # The loss of the same images and the votes that were counted are shared, not made again.
        other = copy(self)
        other.gaussians, other._session = gaussians.map(lambda value: value.to(self._device)), session
        return other

    def everywhere(self) -> EngineContext:
        # The session is shared: another would hold a render per camera of the same scene.
        other = copy(self)
        other._session, other._change = self.session, None
        return other
