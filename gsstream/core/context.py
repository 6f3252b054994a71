"""What a part may see of a frame (FrameContext), and what it may do with it (FrameWork)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from gsstream.core.hierarchy import Hierarchy

if TYPE_CHECKING:
    import torch

    from gsstream.core.cameras import Cameras
    from gsstream.core.changes.motion import Moves
    from gsstream.core.gaussians import Gaussians
    from gsstream.core.shapes import FloatArray


class ScreenGradient(NamedTuple):
    """Gradient of a per-view loss with respect to the 2-D means.

    ``gradient`` [N, 2] per pixel of image-plane motion (0 where not visible), ``visible`` [N] bool.
    """

    gradient: torch.Tensor
    visible: torch.Tensor


class MovedPull(NamedTuple):
    """What a view says of groups of rows that moved.

    Arguments:
        loss: of the view.
        slope: [K, 6] its gradient by shift [per scene unit] and turn [per tan(angle / 2)] of the groups.
        curvature: [K, 6, 6] how fast that gradient grows where a group moves on, a symmetric block for each; None where
            nobody asked for it. See ``gsstream.motion.curvature``.
    """

    loss: float
    slope: FloatArray
    curvature: FloatArray | None = None


class RowGradient(NamedTuple):
    """The same of the rows that it reaches: ``rows`` [K] int64, ascending; ``gradient`` [K, 2]. All others have 0."""

    rows: torch.Tensor
    gradient: torch.Tensor


class FrameContext(Protocol):
    """What an estimator may look at. Nothing here can be changed, and no call leaves a gradient behind."""

    @property
    def index(self) -> int:
        """Frame index, from 1 (frame 0 has no predecessor)."""

    @property
    def gaussians(self) -> Gaussians[torch.Tensor]:
        """The scene of frame t-1 as the player has it."""

    @property
    def hierarchy(self) -> Hierarchy: ...

    @property
    def cameras(self) -> Cameras:
        """The V training cameras."""

    def image(self, view: int) -> torch.Tensor:
        """Return [H, W, 3]: what a camera recorded in frame t, in [0, 1]."""

    def previous_image(self, view: int) -> torch.Tensor:
        """Return [H, W, 3]: what a camera recorded in the frame that ``gaussians`` shows, in [0, 1]."""

    def previous_render(self, view: int) -> torch.Tensor:
        """Return [H, W, 3]: ``gaussians`` as a camera would record them, without a gradient."""

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """Pull an upstream gradient [H, W, 3] back to the 2-D means of ``gaussians`` in one backward pass."""

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        """Return what :meth:`screen_gradient` does of the rows that it reaches, without arrays of all N rows."""

    def noise_sigma(self, view: int) -> float:
        """Return the robust standard deviation of a camera's noise between two frames, in [0, 1] image units."""


class FrameWork(FrameContext, Protocol):
    """A frame that a part works on: it renders with some rows moving, and is told how well that explains the images.

    Colour maps of the cameras are applied and pulled through where they belong; a part need not know them.
    """

    @property
    def effort(self) -> float:
        """Share of the usual passes that the frame is worth, above 0 to 1: less where a run is behind its recording."""

    @property
    def optimiser(self) -> Any:
        """The optimiser of the run (``gsstream.api.RowOptimiser``), for rows that a part fits on its own."""

    def changed_rows(self, least_votes: float) -> torch.Tensor:
        """Return [N] bool: Gaussians that are seen in a tile that changed.

        Arguments:
            least_votes: least share, 0 to 1, of the views a Gaussian projects into in which it must lie in or beside a
                changed tile. Where change is not detected, all Gaussians count.
        """

    def narrow(self, rows: torch.Tensor) -> None:
        """Freeze all rows but [A] int64, ascending: from now on only these move."""

    def pull(self, view: int, rows: Gaussians[torch.Tensor], near_change: bool = False) -> float:
        """Render a view with these values of the rows that move, and compare it with what its camera recorded.

        Arguments:
            view: index of a training camera.
            rows: the A rows of :meth:`narrow`, or all N; tensors with a graph get the gradient of the loss.
            near_change: leave out the tiles that did not change and lie beside none that did.

        Returns:
            (1 - w) L1 + w (1 - SSIM), on the tiles that the rows can change.
        """

    def pull_moved(
        self, view: int, rows: Gaussians[FloatArray], moves: Moves, near_change: bool = False, curved: bool = False
    ) -> MovedPull | None:
        """Return loss and gradient by shift and turn of groups, if the renderer has a call for it.

        None where it has none; ``gsstream.blocks.slope_of`` asks this first and gives the gradient in any case.

        Arguments:
            view: index of a training camera.
            rows: the A rows of :meth:`narrow` before they move.
            moves: of these rows, which it counts from 0 to A - 1.
            near_change: as for :meth:`pull`.
            curved: return the curvature, too.
        """

    def structure(self, view: int, rows: Gaussians[torch.Tensor], near_change: bool = False) -> FloatArray:
        """Return [A, 3]: how firmly the picture holds each row where it is.

        Sums over the pixels of a view: the share that a row has of a pixel's light, times the structure tensor (xx, xy,
        yy, per pixel^2) of the render there, each value weighed by 1 / (its distance from what the camera recorded).

        Arguments:
            view: index of a training camera.
            rows: the A rows of :meth:`narrow`.
            near_change: as for :meth:`pull`.
        """

    def shown(self, gaussians: Gaussians[torch.Tensor], view: int) -> torch.Tensor:
        """Return [H, W, 3]: a scene as the camera of this view would record it, without a graph."""

    def on(self, gaussians: Gaussians[torch.Tensor]) -> FrameWork:
        """Return the same frame, to be worked on from another scene."""
