"""FrameContext: the read-only view of a frame step that a confidence estimator is given."""

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
        """[H, W, 3] ground truth of frame t."""

    def previous_image(self, view: int) -> torch.Tensor:
        """[H, W, 3] ground truth of frame t-1."""

    def previous_render(self, view: int) -> torch.Tensor:
        """[H, W, 3] render of ``gaussians``, no gradient."""

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """Pull an upstream gradient [H, W, 3] back to the 2-D means of ``gaussians`` in one backward pass."""

    def noise_sigma(self, view: int) -> float:
        """Robust standard deviation of the camera's noise between two frames, in [0, 1] image units."""
