"""One frame as parts and methods see it: images, what changed, gradients, and rendering with some rows moving."""

from __future__ import annotations

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import Moves
from gsstream.core.context import MovedPull, RowGradient, ScreenGradient
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import unpacked
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.fit.judge import Judge, shown
from gsstream.engine.fit.schedule import DSSIM
from gsstream.engine.step.active.candidates import VoteBook, changed_rows
from gsstream.engine.step.active.change import MOST_PIXEL_SIGMA, Change
from gsstream.metrics.noise import noise_sigma
from gsstream.optimiser.base import RowOptimiser
from gsstream.render.base import RenderSession


class FrameView:
    """One frame over a decoded scene (implements ``core.context.FrameWork`` and ``method.tools.FrameTools``).

    Images are as recorded; gradients are pulled through the camera's colour map, so that parts need not know it.

    Arguments:
        gaussians, hierarchy: the decoded scene before the frame and its groups.
        previous: training images that this scene shows.
        change: what changed since; None: everything counts as changed.
        session: a render session of this scene that is kept from before, or None.
        judge: of the same images and colour maps, which has made of them what it needs; None: a new one.
        votes: counted so far in the frame; None: none.
    """

    def __init__(
        self, parts: Assembly, gaussians: Gaussians[torch.Tensor], hierarchy: Hierarchy, frame: Frame, previous: Frame,
        exposure: Exposure | None, change: Change | None = None, session: RenderSession | None = None,
        judge: Judge | None = None, votes: VoteBook | None = None,
    ) -> None:  # fmt: skip
        self._parts, self._gaussians, self._hierarchy = parts, gaussians, hierarchy
        self._frame, self._previous, self._change = frame, previous, change
        self._background = parts.recipe.background
        # What the level "step" looks at, images and their gradients, is not seen where a session does all in one call.
        in_one_go = parts.checks is not Checks.STEP
        self.judge = judge or Judge(parts.loss, DSSIM, frame.images, exposure, in_one_go)
        self._session = session
        self._votes = votes or (None if change is None else VoteBook(change, frame.cameras))

    @property
    def session(self) -> RenderSession:
        """The render session of this scene: what the last frame or a part made it project is not done again."""
        if self._session is None:
            self._session = self._parts.renderer.open(self._gaussians, None, self.cameras, self._background)
        return self._session

    def session_for(self, rows: torch.Tensor) -> RenderSession:
        """Return the session in which only ``rows`` change; a new one when all do, since no cache is of use then."""
        if len(rows) == len(self._gaussians):
            return self._parts.renderer.open(self._gaussians, None, self.cameras, self._background)
        self.session.narrow(rows)
        return self.session

    @property
    def index(self) -> int:
        return self._frame.index

    @property
    def effort(self) -> float:
        return self._frame.effort

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        return self._gaussians

    @property
    def hierarchy(self) -> Hierarchy:
        return self._hierarchy

    @property
    def cameras(self) -> Cameras:
        return self._frame.cameras

    def image(self, view: int) -> torch.Tensor:
        return torch.from_numpy(self._frame.images[view])

    def previous_image(self, view: int) -> torch.Tensor:
        return torch.from_numpy(unpacked(self._previous.images[view]))

    def previous_render(self, view: int) -> torch.Tensor:
        return self.shown(self._gaussians, view)

    def shown(self, gaussians: Gaussians[torch.Tensor], view: int) -> torch.Tensor:
        return shown(self._parts.renderer, gaussians, self.cameras, view, self._background, self.judge.exposure)

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        if self._stands_still(view):
            number = len(self._gaussians)
            return ScreenGradient(torch.zeros(number, 2), torch.zeros(number, dtype=torch.bool))
        return self.session.screen_gradient(view, self._upstream(view, image_gradient))

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        if self._stands_still(view):
            return RowGradient(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2))
        return self.session.screen_gradient_rows(view, self._upstream(view, image_gradient))

    def _stands_still(self, view: int) -> bool:
        return self._change is not None and not bool(self._change.tiles[view].any())

    def _upstream(self, view: int, image_gradient: torch.Tensor) -> torch.Tensor:
        """A gradient by what a camera records, in the tiles that changed, as one by the scene's colours."""
        upstream = image_gradient.float()
        if self._change is not None:
            upstream = upstream * self._change.pixels(view)
        if self.judge.exposure:
            upstream = self.judge.exposure.pull(view, upstream)
        return upstream.contiguous()

    def noise_sigma(self, view: int) -> float:
        # Where everything moves, the estimate measures the motion instead of the noise, so it is bounded; see
        # MOST_SIGMA.
        measured = noise_sigma(unpacked(self._previous.images[view]), self._frame.images[view])
        return min(measured, MOST_PIXEL_SIGMA)

    @property
    def optimiser(self) -> RowOptimiser:
        return self._parts.optimiser

    def changed_rows(self, least_votes: float) -> torch.Tensor:
        return changed_rows(
            self._change, self._gaussians.means, self.cameras, self.session, least_votes, self._votes
        )

    def narrow(self, rows: torch.Tensor) -> None:
        self._session = self.session_for(rows)

    def pull_moved(
        self, view: int, rows: Gaussians[FloatArray], moves: Moves, near_change: bool = False, curved: bool = False
    ) -> MovedPull | None:
        if not self.judge.in_one_go:
            return None
        comparison = self.judge.comparison(view, self._tiles(view, near_change))
        pulled = self.session.pull_moved(view, rows, moves, comparison, curved)
        if pulled is not None:
            self._parts.where.count()
        return pulled

    def structure(self, view: int, rows: Gaussians[torch.Tensor], near_change: bool = False) -> FloatArray:
        self._parts.where.count()
        return self.judge.structure(self.session, view, rows, self._tiles(view, near_change))

    def _tiles(self, view: int, near_change: bool) -> torch.Tensor | None:
        """Factors on the gradients of tiles; None: all count."""
        return self._change.near[view].float() if near_change and self._change is not None else None

    def pull(self, view: int, rows: Gaussians[torch.Tensor], near_change: bool = False) -> float:
        self._parts.where.count()
        tiles = self._tiles(view, near_change)
        loss, gradients = self.judge.pull(self.session, view, rows, tiles)
        pairs = [(value, gradient) for (_, value), (_, gradient) in zip(rows.items(), gradients.items(), strict=True)]
        if learned := [(value, gradient) for value, gradient in pairs if value.requires_grad]:
            pull_back(*zip(*learned, strict=True))
        return loss

    def backward(self, view: int, image: torch.Tensor, tile_mask: torch.Tensor | None = None) -> float:
        self._parts.where.count()
        return self.judge.backward(view, image, tile_mask)[0]

    def on(self, gaussians: Gaussians[torch.Tensor], session: RenderSession | None = None) -> FrameView:
        return FrameView(
            self._parts, gaussians, self._hierarchy, self._frame, self._previous, self.judge.exposure, self._change,
            session, self.judge, self._votes,
        )  # fmt: skip
