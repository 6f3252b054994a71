"""Copies: Gaussians are copied where the gradient is large, and others leave, so that their number stays."""

from __future__ import annotations

from typing import ClassVar, Literal, final

import numpy as np
from pydantic import Field

from gsstream.core.changes import RowEdit, Scene
from gsstream.core.rng import Rng
from gsstream.core.shapes import IntArray
from gsstream.parts.growth.base import Growth
from gsstream.parts.growth.copying import CopySettings, replace_with_copies
from gsstream.parts.render.work import FitContext


@final
class Copies(Growth):
    """Copies Gaussians whose screen gradient is large and fits the copies while the rest does not change.

    In every frame as many Gaussians leave as there are more than the last key packet had.
    """

    source: ClassVar[str] = "HiCoM (Gao et al. 2024), 3DGStream (Sun et al. 2024)"

    class Config(CopySettings):
        leave: Literal["least-opaque", "last-added"] = Field(
            default="least-opaque", description="which leave; last-added: those that the frame before added"
        )

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        kept, number = work.key_rows, len(after.gaussians)
        last = self.config.leave == "last-added"
        rows = np.arange(kept, number) if last else least_opaque(after, number - kept)
        return replace_with_copies(after, rows, work, self.config, rng)


def least_opaque(scene: Scene, number: int) -> IntArray:
    """Return the rows, ascending, of the least opaque Gaussians; none where ``number`` is not above 0."""
    return np.sort(np.argsort(scene.gaussians.opacities, kind="stable")[: max(0, number)])
