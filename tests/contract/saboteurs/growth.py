"""Saboteurs of the checks of growth parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.changes import RowEdit, add_to_nodes
from gsstream.testing.examples.growth import ExampleGrowth
from gsstream.testing.method_driver import INDEX
from saboteurs.register import spoils

Base: Any = ExampleGrowth
CALLS: dict[str, int] = {"moody": 0, "loose": 0}


def copies(scene: Any, number: int, unit: int = 0) -> RowEdit:
    """The first Gaussians once more, beside themselves."""
    rows = np.arange(number)
    born = scene.gaussians.rows(rows)
    return RowEdit(add_to_nodes(born, scene.layout.node_of[rows], np.full(number, unit, np.uint8)))


@spoils("check_growth_fits")
class Strange(Base):
    """Adds Gaussians of a unit that the scene does not have."""

    def propose(self, after: Any, work: Any, rng: Any) -> Any:
        if work.index != INDEX or not bool(work.changed_rows(0.0).any()):
            return super().propose(after, work, rng)
        return copies(after, 2, unit=63)


@spoils("check_growth_pure")
class Moody(Base):
    """Adds one more at every call."""

    def propose(self, after: Any, work: Any, rng: Any) -> Any:
        if work.index != INDEX or not bool(work.changed_rows(0.0).any()):
            return super().propose(after, work, rng)
        CALLS["moody"] += 1
        return copies(after, CALLS["moody"])


@spoils("check_growth_ends")
class Restless(Base):
    """Adds Gaussians where nothing changes."""

    def propose(self, after: Any, work: Any, rng: Any) -> Any:
        if work.index != INDEX or bool(work.changed_rows(0.0).any()):
            return super().propose(after, work, rng)
        return copies(after, 1)


@spoils("check_growth_closed_loop")
class Loose(Base):
    """Adds one more in every run."""

    def propose(self, after: Any, work: Any, rng: Any) -> Any:
        if work.index != 1:
            return super().propose(after, work, rng)
        CALLS["loose"] += 1
        return copies(after, CALLS["loose"])
