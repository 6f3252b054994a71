"""Who may change in a frame: the one pure function behind "cost follows change".

A Gaussian is a candidate when it is seen in a changed tile of some training view, when its centre lies in or beside
changed tiles in enough of the views that it projects into, and when its gate may open. Everything else is frozen: it is
neither projected nor optimised nor sent.

The vote keeps many cameras from making everything a candidate: a wall is behind a moving person in some view, but only
what moves lies in changed tiles in most of them (the idea of a visual hull).
"""

from __future__ import annotations

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import IntArray
from gsstream.engine.step.active.change import Change, detect_change
from gsstream.render.base import RenderSession


def candidates(
    changed: torch.Tensor, open_probability: torch.Tensor, hierarchy: Hierarchy, threshold: float
) -> torch.Tensor:
    """Return the rows [A] int64, ascending, that take part in a frame.

    Arguments:
        hierarchy: node of each Gaussian.
        changed: [N] bool of :func:`changed_rows`.
        open_probability: [M] probability that a node's gate is not zero.
        threshold: rows whose gate opens with at most this probability are left out.
    """
    return ((open_probability > threshold)[hierarchy.node_of] & changed).nonzero()[:, 0]


def changed_rows(
    change: Change | None, means: torch.Tensor, cameras: Cameras, session: RenderSession, least_votes: float
) -> torch.Tensor:
    """Return [N] bool: Gaussians seen in a changed tile, with at least this share of votes; all without a ``change``.

    Arguments:
        change: changed tiles of every view; None where change is not detected.
        cameras: training cameras.
        means: [N, 3] centres of the session's scene.
        session: asked which Gaussians are visible in which tiles.
        least_votes: 0 to 1.
    """
    if change is None:
        return torch.ones(len(means), dtype=torch.bool)
    if not bool(change.tiles.any()):
        return torch.zeros(len(means), dtype=torch.bool)
    seen = session.visible_anywhere(change.tiles)
    rows = seen.nonzero()[:, 0]
    seen[rows] = change.votes(means[rows], cameras) >= least_votes
    return seen


def rows_in_change(
    session: RenderSession, means: torch.Tensor, previous: Frame, frame: Frame, threshold: float, least_votes: float
) -> IntArray:
    """Return the rows [A] int64, ascending, in what changed between two frames; all where it is not detected.

    Arguments:
        session: of the scene that ``previous`` shows.
        means: [N, 3] its centres.
        previous, frame: training images before and now.
        threshold: as for :func:`detect_change`.
        least_votes: as for :func:`changed_rows`.
    """
    change = detect_change(previous, frame, threshold)
    return changed_rows(change, means, frame.cameras, session, least_votes).nonzero()[:, 0].numpy()


def released(gates: torch.Tensor, num_levels: int, hierarchy: Hierarchy, waiting: torch.Tensor | None) -> torch.Tensor:
    """Return [A] bool: rows that stay in the optimisation; those whose gate has closed leave it.

    A closed gate draws its rows as they were, so nothing that is seen changes.

    Arguments:
        num_levels: gate values that are not zero.
        hierarchy: node of each of the A rows.
        gates: [M] deterministic gates as they are now.
        waiting: [A] bool, rows of units that do not take part yet: they had no say and stay. None: no row waits.
    """
    keep = (torch.round(gates * num_levels) > 0)[hierarchy.node_of]
    return keep if waiting is None else keep | waiting
