"""Delta: what one frame changes, as the integers that are transmitted, and the one function that applies it.

Encoder and player call the same :func:`apply_delta` on numpy arrays, so the state they reach is equal by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from gsstream.core.changes.field import Field, apply_field
from gsstream.core.changes.history import displacement_between
from gsstream.core.changes.light import Light, apply_light
from gsstream.core.changes.motion import Motion, apply_motions, union_rows
from gsstream.core.changes.residual import Residual, apply_residual, sent_rows
from gsstream.core.changes.rows import AddedGaussians, RowEdit, apply_row_edit, gather_rows, join_rows
from gsstream.core.changes.scene import Layout, Scene
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray, IntArray

Change: TypeAlias = Light | Motion | Field | Residual | RowEdit
#: The order in which kinds of changes stand in a delta; only motions may stand there more than once.
ORDER: tuple[type[Change], ...] = (Light, Motion, Field, Residual, RowEdit)


@dataclass(frozen=True, slots=True)
class Delta:
    """One frame's changes, applied one after the other: a light, motions, a field, a residual and a change of rows.

    Each is optional; of motions there may be several. Raises ShapeError for another order.
    """

    changes: tuple[Change, ...] = ()

    def __post_init__(self) -> None:
        ranks = [ORDER.index(type(change)) for change in self.changes]
        if ranks != sorted(ranks) or max(map(ranks.count, (0, 2, 3, 4))) > 1:
            names = ", ".join(type(change).__name__ for change in self.changes)
            raise ShapeError(
                f"delta: expected one light, then motions, then one field, one residual and one change of rows, got "
                f"{names}"
            )

    @property
    def light(self) -> Light | None:
        """The factor on all colours, if there is one."""
        return next((change for change in self.changes if isinstance(change, Light)), None)

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The motions, in order."""
        return tuple(change for change in self.changes if isinstance(change, Motion))

    @property
    def field(self) -> Field | None:
        """The field, if there is one."""
        return next((change for change in self.changes if isinstance(change, Field)), None)

    @property
    def residual(self) -> Residual | None:
        """The residual, if there is one."""
        return next((change for change in self.changes if isinstance(change, Residual)), None)

    @property
    def row_edit(self) -> RowEdit | None:
        """The change of rows, if there is one."""
        return next((change for change in self.changes if isinstance(change, RowEdit)), None)

    @property
    def added(self) -> AddedGaussians | None:
        """Gaussians that are added, or None."""
        return None if self.row_edit is None else self.row_edit.added

    @property
    def removed(self) -> IntArray:
        """[D] rows that are removed."""
        return np.zeros(0, np.int64) if self.row_edit is None else self.row_edit.removed

    @property
    def is_empty(self) -> bool:
        """Whether nothing changes."""
        return all(change.is_empty for change in self.changes)

    @property
    def is_light_at_most(self) -> bool:
        """Whether nothing but the light changes."""
        return all(change.is_empty or isinstance(change, Light) for change in self.changes)

    @property
    def has_row_edit(self) -> bool:
        """Whether Gaussians are added or removed."""
        return self.row_edit is not None and not self.row_edit.is_empty

    def gates(self, layout: Layout) -> IntArray:
        """Return the gates [M] of the residual; all closed without one."""
        residual = self.residual
        return np.zeros(len(layout.node_counts), np.uint8) if residual is None else residual.gates

    def with_residual(self, residual: Residual | None) -> Delta:
        """Return the same delta with another residual, or with none."""
        others: list[Change] = [change for change in self.changes if not isinstance(change, Residual)]
        if residual is not None:
            others.insert((self.light is not None) + len(self.motions) + (self.field is not None), residual)
        return Delta(tuple(others))

    def with_light(self, light: Light | None) -> Delta:
        """Return the same delta in another light, or with none."""
        others = tuple(change for change in self.changes if not isinstance(change, Light))
        return Delta(others if light is None or light.is_empty else (light, *others))

    def with_row_edit(self, row_edit: RowEdit | None) -> Delta:
        """Return the same delta with another change of rows, or with none."""
        others = tuple(change for change in self.changes if not isinstance(change, RowEdit))
        return Delta(others if row_edit is None or row_edit.is_empty else (*others, row_edit))


def apply_delta(scene: Scene, delta: Delta) -> Scene:
    """Return the next frame's scene, and what moved in it.

    Rows that no change touches keep their bits. Raises ShapeError when the delta does not fit the scene.
    """
    if delta.light is not None:
        scene = apply_light(scene, delta.light)
    after, touched = apply_motions(scene, delta.motions)
    if delta.field is not None:
        after, rows = apply_field(after, delta.field)
        touched = union_rows(len(after.gaussians), touched, rows)
    if delta.residual is not None:
        after = replace(after, gaussians=apply_residual(after.gaussians, after.layout, delta.residual))
        touched = union_rows(len(after.gaussians), touched, sent_rows(after.layout, delta.residual.gates))
    after = replace(after, displacement=displacement_between(scene.gaussians, after.gaussians, touched), heading=None)
    return after if delta.row_edit is None else apply_row_edit(after, delta.row_edit)


def row_gates(layout: Layout, delta: Delta) -> FloatArray:
    """Return the gate [N'] float32, 0 to 1, of every row after the delta; added rows are open.

    ``layout`` is that before the delta.
    """
    residual = delta.residual
    if residual is None:
        gates = np.zeros(len(layout.unit_of), np.float32)
    else:
        gates = np.repeat(residual.gates, layout.node_counts).astype(np.float32) / np.float32(residual.num_levels)
    if not delta.has_row_edit:
        return np.asarray(gates)
    added = None if delta.added is None else np.ones(len(delta.added), np.float32)
    return join_rows(gates, added, gather_rows(layout.node_of, delta.added, delta.removed))
