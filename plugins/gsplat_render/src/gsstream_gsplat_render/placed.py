"""Some rows put into the six tables of a scene, with a gradient by these rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True, slots=True)
class RowKernels:
    """Functions of some rows of all tables of a scene, with the signatures of those in torch below."""

    put: Callable[..., Any]
    take: Callable[..., Any]


def put_rows(index: torch.Tensor, *tables: torch.Tensor) -> None:
    """Put rows into a scene, in place.

    Arguments:
        index: [A] int64, no duplicates.
        tables: rows [A, ...] of means, quats, scales, opacities, sh0 and shN, then those six tables [N, ...]; float32.
    """
    for rows, whole in zip(tables[:6], tables[6:], strict=True):
        whole.index_copy_(0, index, rows)


def take_rows(index: torch.Tensor, *whole: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return the rows ``index`` [A] int64 of the six tables [N, ...] of a scene, float32."""
    return tuple(table.index_select(0, index) for table in whole)


ROWS_IN_TORCH = RowKernels(put_rows, take_rows)


class Placed(torch.autograd.Function):
    """The six tables of a scene with other rows ``index`` [A], which are put into the very tables.

    Only the rows have a gradient. It is that of one use of the tables: the next puts other rows into them.
    """

    @staticmethod
    def forward(
        ctx: Any, kernels: RowKernels, index: torch.Tensor, whole: tuple[torch.Tensor, ...], *rows: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        kernels.put(index, *rows, *whole)
        ctx.set_materialize_grads(False)
        ctx.kernels, ctx.index, ctx.whole = kernels, index, whole
        return tuple(table.view_as(table) for table in whole)

    @staticmethod
    def backward(ctx: Any, *upstream: Any) -> Any:
        # Of a table that has no gradient anything may be taken: nobody looks at it.
        given = [table if grad is None else grad for grad, table in zip(upstream, ctx.whole, strict=True)]
        taken = ctx.kernels.take(ctx.index, *given)
        return None, None, None, *(None if grad is None else rows for grad, rows in zip(upstream, taken, strict=True))
