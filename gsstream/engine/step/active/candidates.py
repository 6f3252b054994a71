"""Which rows may change in a frame: the one pure function behind "cost follows change".

A Gaussian is a candidate when it is seen in a changed tile of some training view, when its centre lies in or beside
changed tiles in enough of the views that it projects into, and when its gate may open. Everything else is frozen: it is
neither projected nor optimised nor sent.

The vote keeps many cameras from making everything a candidate: a wall is behind a moving person in some view, but only
what moves lies in changed tiles in most of them (the idea of a visual hull).
"""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.step.active.change import Change
from gsstream.engine.step.active.change_on_device import votes_on_device
from gsstream.parts.render.session import RenderSession

#: Least share of the views a Gaussian projects into in which it must lie in or beside changed tiles.
CHANGE_VOTES = 0.75


def candidates(
    changed: torch.Tensor, open_probability: torch.Tensor, hierarchy: Hierarchy, threshold: float
) -> torch.Tensor:
    """Return the rows [A] int64, ascending, that take part in a frame."""
    return ((open_probability > threshold)[hierarchy.node_of] & changed).nonzero()[:, 0]


class VoteCache:
    """The votes of a frame that were counted so far: a centre that has not moved since keeps its own."""

    def __init__(self, change: Change, cameras: Cameras) -> None:
        self._change, self._cameras = change, cameras
        self._means, self._votes = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)

    def of(self, means: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return the votes [A] of these rows [A] int64 of a scene with centres [N, 3], see :meth:`Change.votes`."""
        centres, asked = means.numpy(), rows.numpy()
        if len(centres) != len(self._means):
            self._means = np.full_like(centres, np.nan)  # equal to no centre
            self._votes = np.zeros(len(centres), np.float32)
        now, before = centres[asked], self._means[asked]
        known = (now[:, 0] == before[:, 0]) & (now[:, 1] == before[:, 1]) & (now[:, 2] == before[:, 2])
        fresh = asked[~known]
        if len(fresh):
            self._means[fresh] = centres[fresh]
            self._votes[fresh] = self._change.votes(torch.from_numpy(centres[fresh]), self._cameras).numpy()
        return torch.from_numpy(self._votes[asked])


def changed_rows(
    change: Change | None,
    means: torch.Tensor,
    cameras: Cameras,
    session: RenderSession,
    min_votes: float,
    book: VoteCache | None = None,
) -> torch.Tensor:
    """Return [N] bool: Gaussians seen in a changed tile, with at least this share of votes; all without a ``change``.

    Arguments:
        change: changed tiles of every view; None where change is not detected.
        cameras: training cameras.
        means: [N, 3] centres of the session's scene.
        session: asked which Gaussians are visible in which tiles.
        min_votes: 0 to 1.
        book: cache of the votes that other scenes of this frame have counted; None: nothing is cached.
    """
    if change is None:
        return means.new_ones(len(means), dtype=torch.bool)
    if means.device.type != "cpu":
        return session.visible_anywhere(change.tiles) & (votes_on_device(change, means, cameras) >= min_votes)
    if not bool(change.tiles.any()):
        return torch.zeros(len(means), dtype=torch.bool)
    seen = session.visible_anywhere(change.tiles)
    rows = seen.nonzero()[:, 0]
    seen[rows] = (book or VoteCache(change, cameras)).of(means, rows) >= min_votes
    return seen


def keep_mask(gates: torch.Tensor, num_levels: int, hierarchy: Hierarchy, waiting: torch.Tensor | None) -> torch.Tensor:
    """Return [A] bool: rows that stay in the optimisation; those whose gate has closed leave it.

    A closed gate draws its rows as they were, so nothing that is seen changes.
    """
    keep = (torch.round(gates * num_levels) > 0)[hierarchy.node_of]
    return keep if waiting is None else keep | waiting
