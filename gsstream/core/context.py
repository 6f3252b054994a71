"""What a part may see of a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from gsstream.core.hierarchy import Hierarchy

if TYPE_CHECKING:
    import torch

    from gsstream.core.cameras import Cameras
    from gsstream.core.gaussians import Gaussians


class ScreenGradient(NamedTuple):
    """Gradient of a per-view loss with respect to the 2-D means.

    ``gradient`` [N, 2] per pixel of image-plane motion (0 where not visible), ``visible`` [N] bool.
    """

    gradient: torch.Tensor
    visible: torch.Tensor


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
        """Return the image [H, W, 3] of a camera in frame t, in [0, 1]."""

    def previous_image(self, view: int) -> torch.Tensor:
        """Return the image [H, W, 3] of a camera, in [0, 1], that frame t is compared with.

        It is of the frame that ``gaussians`` shows. Tiles that have not changed since are of the frame that it showed
        before its last packet: what changed then is worked on once more.
        """

    def image_change(self, view: int) -> torch.Tensor:
        """Return [H, W, 3]: ``image`` minus ``previous_image`` in the tiles that changed, and 0 in the others."""

    def previous_render(self, view: int) -> torch.Tensor:
        """Return [H, W, 3]: ``gaussians`` as a camera would record them, without a gradient."""

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """Backpropagate an upstream gradient [H, W, 3] to the 2-D means of ``gaussians`` in one backward pass."""

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        """Return the rows that :meth:`screen_gradient` reaches, and their gradients, without arrays of N rows."""

    def noise_sigma(self, view: int) -> float:
        """Return the robust standard deviation of a camera's noise between two frames, in [0, 1] image units."""
