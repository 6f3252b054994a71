"""What every growth part promises, on a frame of 32 x 24 pixels."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import RowEdit, apply_row_edit
from gsstream.packet.changes.rows import encode_rows_change
from gsstream.parts.growth.base import Growth
from gsstream.testing.cases import fingerprint
from gsstream.testing.method_driver import check_closed_loop, fit_fixture
from gsstream.testing.registry import check


def _proposed(part: Growth, *, changed: bool = True) -> RowEdit | None:
    case = fit_fixture(changed=changed)
    rows = part.propose(case.scene, case.work, case.rng)
    assert rows is None or isinstance(rows, RowEdit), f"propose(): expected RowEdit or None, got {type(rows).__name__}"
    return rows


@check("growth")
def check_growth_fits(part: Growth) -> None:
    """A proposal can be written and applied: rows that leave exist, rows that join have a node and a unit."""
    scene, rows = fit_fixture().scene, _proposed(part)
    if rows is None:
        return
    encode_rows_change(rows, scene.layout)
    after = apply_row_edit(scene, rows)
    added = 0 if rows.added is None else len(rows.added)
    wanted = len(scene.gaussians) - len(rows.removed) + added
    assert len(after.gaussians) == wanted, f"expected {wanted} Gaussians afterwards, got {len(after.gaussians)}"
    for name, value in after.gaussians.items():
        bad = int((~np.isfinite(value)).sum())
        assert bad == 0, f"{name}: expected finite values, got {bad} that are not"


@check("growth")
def check_growth_pure(part: Growth) -> None:
    """The scene stays as it was, and the same frame gives the same rows again."""
    case = fit_fixture()
    before = fingerprint((case.scene.gaussians, case.scene.layout))
    first = part.propose(case.scene, case.work, case.rng)
    assert fingerprint((case.scene.gaussians, case.scene.layout)) == before, "the scene was changed"
    assert fingerprint(first) == fingerprint(_proposed(part)), "the second call gives other rows than the first"


@check("growth")
def check_growth_ends(part: Growth) -> None:
    """Where no tile of any view changed, nothing is added."""
    rows = _proposed(part, changed=False)
    added = 0 if rows is None or rows.added is None else len(rows.added)
    assert added == 0, f"nothing changed: expected no added Gaussians, got {added}"


@check("growth")
def check_growth_closed_loop(part: Growth) -> None:
    """A method with this part: a player reaches the encoder's state bit by bit, a second run writes the same bytes."""
    check_closed_loop("growth", part)
