"""What a part that fits something may do with a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol

import torch

from gsstream.core.context import FrameContext
from gsstream.core.gaussians import Gaussians
from gsstream.core.log import FrameLog

if TYPE_CHECKING:
    from gsstream.parts.render.wrt import G, LossAndGrad, Wrt


class FitContext(FrameContext, Protocol):
    """A frame that a part may optimise: render it with some rows active, and get loss and gradient.

    Colour maps of the cameras are applied and differentiated where they belong; a part need not know them.
    """

    @property
    def optimiser(self) -> Any:
        """The optimiser of the run (``gsstream.backend.RowOptimiser``), for rows that a part fits on its own."""

    @property
    def log(self) -> FrameLog:
        """The record of the frame: phases within the part's own (``"motion/fit"``) and numbers."""

    @property
    def key_rows(self) -> int:
        """Number of Gaussians of the last key packet: rows from there on were added since, where none was removed."""

    def scaled(self, number: float) -> int:
        """Return how many passes or iterations the frame is worth, at least 1, where ``number`` is usual.

        It is less where a run is behind its recording, or where a budget of time has to be met without a residual.
        """

    @property
    def shell_rows(self) -> torch.Tensor:
        """[N] bool: Gaussians behind the scene, which no frame moves, changes, copies or removes."""

    def changed_rows(self, min_votes: float) -> torch.Tensor:
        """Return [N] bool: Gaussians that are seen in a tile that changed, but for those of the shell.

        Arguments:
            min_votes: least share, 0 to 1, of the views a Gaussian projects into in which it must lie in or beside a
                changed tile. Where change is not detected, all Gaussians count.
        """

    def narrow(self, rows: torch.Tensor) -> None:
        """Freeze all rows but [A] int64, ascending: from now on only these move."""

    def loss_and_grad(self, view: int, wrt: Wrt[G], tiles: Literal["all", "changed"] = "all") -> LossAndGrad[G]:
        """Render a view, compare it with what its camera recorded, and differentiate.

        Arguments:
            view: index of a training camera.
            wrt: the A rows of :meth:`narrow` (or all N), or the transforms of groups of them.
            tiles: "changed" leaves out the tiles that did not change and lie beside none that did.

        Returns:
            (1 - w) L1 + w (1 - SSIM) on the tiles that the rows can change, and its gradient. Values that were computed
            from others pass it on with ``gsstream.blocks.rows_backward``.
        """

    def shown(self, gaussians: Gaussians[torch.Tensor], view: int) -> torch.Tensor:
        """Return [H, W, 3]: a scene as the camera of this view would record it, without a graph."""

    def on(self, gaussians: Gaussians[torch.Tensor]) -> FitContext:
        """Return the same frame, to be worked on from another scene."""

    def everywhere(self) -> FitContext:
        """Return the same frame and scene, in which every tile counts as changed; gradients then reach all rows."""
