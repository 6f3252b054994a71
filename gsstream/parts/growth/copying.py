"""Gaussians that are copied where the gradient is large, and fitted while the rest does not change."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal, final

import numpy as np
import torch
from pydantic import Field

from gsstream.core.changes import RowEdit, Scene, add_as_nodes
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import PartConfig
from gsstream.core.rng import Rng
from gsstream.core.shapes import IntArray
from gsstream.parts.growth.base import Growth
from gsstream.parts.growth.fitting import concat_gaussians, fit_added
from gsstream.parts.render.work import FitContext

#: (frame as a scene shows it, rows [P], the largest gradient first) -> those that may be copied, in that order.
CopyFilter = Callable[[FitContext, torch.Tensor], torch.Tensor]


class CopySettings(PartConfig):
    """How many Gaussians a frame copies, where, and how long they are fitted."""

    epochs: int = Field(
        default=5, ge=0, le=1000, description="passes over the training cameras that fit the copies; 0: none is made"
    )
    rounds: int = Field(default=2, ge=1, le=10, description="times that the scene is searched for places")
    gradient: float = Field(
        default=2e-4, gt=0, description="mean screen gradient (half-width units) above which a Gaussian is copied"
    )
    most: int = Field(default=500, ge=0, le=100_000, description="Gaussians that a frame adds at most")
    prune_opacity: float = Field(
        default=0.01, ge=0, lt=1, description="added Gaussians below this opacity are not sent, 0 to 1"
    )


def replace_with_copies(
    scene: Scene,
    removed: IntArray,
    work: FitContext,
    settings: CopySettings,
    rng: Rng,
    admitted: CopyFilter | None = None,
) -> RowEdit:
    """Return the change of rows in which some are removed and the frame's copies are added, each a node of its own.

    Arguments:
        scene: N rows, after the frame's motions.
        removed: [D] int64 rows that are removed, ascending.
        work, settings, rng, admitted: as for :func:`fit_copies`. Where nothing changed, nothing is added.
    """
    if not settings.epochs or not bool(work.changed_rows(0.0).any()):
        return RowEdit(removed=removed)
    kept = scene.gaussians.rows(np.delete(np.arange(len(scene.gaussians)), removed)).map(torch.from_numpy)
    kept = kept.map(lambda value: value.to(work.gaussians.means.device))
    added = fit_copies(kept, work.everywhere(), settings, rng=rng, admitted=admitted).map(
        lambda value: value.cpu().numpy()
    )
    if not len(added):
        return RowEdit(removed=removed)
    return RowEdit(add_as_nodes(added, np.zeros(len(added), np.uint8), len(scene.layout.node_counts)), removed)


def fit_copies(
    scene: Gaussians[torch.Tensor],
    work: FitContext,
    settings: CopySettings,
    rng: Rng,
    admitted: CopyFilter | None = None,
) -> Gaussians[torch.Tensor]:
    """Return the Gaussians that a frame adds to a scene, raw values, at the places that ``admitted`` lets pass.

    The scene is that after the frame's motions and without rows that leave; the passes are spread over the rounds.
    """
    added, views, rounds = scene.rows(slice(0, 0)), list(range(len(work.cameras))), settings.rounds
    epochs = work.scaled(settings.epochs)
    for round_ in range(rounds):
        passes = epochs * (round_ + 1) // rounds - epochs * round_ // rounds
        room = settings.most - len(added)
        if not passes or (room <= 0 and not len(added)):
            continue
        base = concat_gaussians(scene, added) if len(added) else scene
        copies = _copies(work.on(base), settings.gradient, max(0, room), admitted)
        added = concat_gaussians(added, copies) if len(added) else copies
        if not len(added):
            continue
        added = fit_added(scene, added, work, views=views, epochs=passes, rng=rng)
        added = added.rows(added.opacities.sigmoid() >= settings.prune_opacity)
    return added


def _copies(work: FitContext, gradient: float, room: int, admitted: CopyFilter | None) -> Gaussians[torch.Tensor]:
    """Copies of at most ``room`` Gaussians. Its renders, one for every camera, are released on return."""
    places = high_gradient_rows(work, gradient)
    if admitted is not None:
        places = admitted(work, places)
    return work.gaussians.rows(places[:room].sort().values)


def high_gradient_rows(work: FitContext, gradient: float) -> torch.Tensor:
    """Return the rows [P] whose mean screen gradient exceeds a bound, the largest first; none of the shell.

    The gradient is that of the mean absolute difference between what a view shows and what its camera recorded; the
    mean is over the views in which it is not zero.

    Arguments:
        work: the frame, seen from the scene that is searched.
        gradient: the bound, in half image widths.
    """
    half = work.gaussians.means.new_tensor([work.cameras.width / 2, work.cameras.height / 2])
    total = torch.zeros_like(work.gaussians.opacities)
    count = total
    for view in range(len(work.cameras)):
        difference = work.previous_render(view) - work.image(view)
        norm = (work.screen_gradient(view, difference.sign() / difference.numel()).gradient * half).norm(dim=1)
        total, count = total + norm, count + (norm > 0)
    grad_norm = total / count.clamp_min(1)
    hot = ((grad_norm > gradient) & ~work.shell_rows).nonzero()[:, 0]
    return hot[torch.argsort(grad_norm[hot], descending=True, stable=True)]


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
        return replace_with_copies(after, rows, work, settings=self.config, rng=rng)


def least_opaque(scene: Scene, number: int) -> IntArray:
    """Return the rows, ascending, of the least opaque Gaussians; none where ``number`` is not above 0."""
    return np.sort(np.argsort(scene.gaussians.opacities, kind="stable")[: max(0, number)])
