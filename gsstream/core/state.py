"""Row alignment of state fields is declared, never guessed from shapes.

A state is a frozen dataclass whose array fields are declared with ``rows("gaussian")``, ``rows("node")`` or
``rows(None)``; saving, loading, editing and comparing are generic over that declaration.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from gsstream.core.topology import TopologyEdit

if TYPE_CHECKING:
    import torch

RowAxis = Literal["gaussian", "node"]
State = TypeVar("State")


def rows(axis: RowAxis | None, **kwargs: Any) -> Any:
    """Declare that a field's first axis is per Gaussian, per node, or not aligned (None)."""
    return field(metadata={"rows": axis}, **kwargs)


def edit_state(state: State, edit: TopologyEdit) -> State:
    """Apply a topology edit to every per-Gaussian field of a state; moments of fresh rows are not zeroed here."""
    changes = {
        f.name: getattr(state, f.name)[edit.source]
        for f in dataclasses.fields(state)  # type: ignore[arg-type]
        if f.metadata.get("rows") == "gaussian" and getattr(state, f.name) is not None
    }
    return dataclasses.replace(state, **changes)  # type: ignore[type-var]


@dataclass(frozen=True)
class GateState:
    """State of a gate sampler: one trainable logit per node. ``logits`` [M] float32."""

    logits: torch.Tensor = rows("node")
