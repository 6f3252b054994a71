"""Which rows may change in a frame: the one pure function behind "cost follows change".

A Gaussian is a candidate when it is seen in a changed tile of some training view, when its centre lies in or beside
changed tiles in enough of the views that it projects into, and when its gate may open. Everything else is frozen: it is
neither projected nor optimised nor sent.

The vote keeps many cameras from making everything a candidate: a wall is behind a moving person in some view, but only
what moves lies in changed tiles in most of them (the idea of a visual hull).
"""

from __future__ import annotations

import torch

from gsstream.core.hierarchy import Hierarchy

#: Least share of the views a Gaussian projects into in which it must lie in or beside changed tiles.
CHANGE_VOTES = 0.75


def candidates(
    changed: torch.Tensor, open_probability: torch.Tensor, hierarchy: Hierarchy, threshold: float
) -> torch.Tensor:
    """Return the rows [A] int64, ascending, that take part in a frame."""
    return ((open_probability > threshold)[hierarchy.node_of] & changed).nonzero()[:, 0]


def keep_mask(gates: torch.Tensor, num_levels: int, hierarchy: Hierarchy, waiting: torch.Tensor | None) -> torch.Tensor:
    """Return [A] bool: rows that stay in the optimisation; those whose gate has closed leave it.

    A closed gate draws its rows as they were, so nothing that is seen changes.
    """
    keep = (torch.round(gates * num_levels) > 0)[hierarchy.node_of]
    return keep if waiting is None else keep | waiting
