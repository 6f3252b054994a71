"""Adam in place on numpy arrays or CPU tensors (Kingma and Ba 2015, algorithm 1), fused and threaded.

Arrays are float32, contiguous, and share their first axis: rows. Further axes are columns: [n], [n, d], [n, k, d].
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsstream_cpu_render import _native
from gsstream_cpu_render.checks import Float32, as_array, native_array, refuse, refuse_value


def adam_rows(
    param: Any,
    grad: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    step: Any,
    *,
    lr: Any,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    rows: Any | None = None,
) -> None:
    """Update the chosen rows in place; each row's bias is corrected by the number of steps that row has taken.

    Args:
        param, exp_avg, exp_avg_sq: [n, ...] float32, changed in place.
        grad: like param, or with one row per id when ``rows`` are ids.
        step: [n] int32 step counts, incremented for touched rows.
        lr: a number, [d] rates per column or [n] per row; if n = d, give it as [1, d] or [n, 1].
        betas: two numbers in [0, 1). eps: >= 0 (1e-15 as in 3D Gaussian splatting).
        rows: None (all), a bool mask [n], or strictly increasing int64 ids.

    Raises:
        ShapeError: shape, dtype, layout, ids, or a gradient value that is not finite.
        InputError: lr, betas or eps out of range.
    """
    table = _Table(param, exp_avg, exp_avg_sq)
    steps = native_array("step", step, np.int32, (table.n,), writable=True)
    _run(table, grad, steps, lr, (*betas, eps), _rows(rows, table.n))


class _Table:
    """Parameter and moments as [n, d] views."""

    def __init__(self, param: Any, exp_avg: Any, exp_avg_sq: Any) -> None:
        shape = as_array("param", param).shape
        if len(shape) == 0:
            refuse("param: expected shape [n, ...], got a scalar")
        self.shape, self.n = shape, shape[0]
        self.d = math.prod(shape[1:])
        named = (("param", param), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq))
        arrays = [native_array(name, value, np.float32, shape, writable=True) for name, value in named]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            if self.n * self.d and np.may_share_memory(arrays[i], arrays[j]):
                refuse(f"{named[j][0]}: expected memory of its own, got memory shared with {named[i][0]}")
        self.param, self.exp_avg, self.exp_avg_sq = (array.reshape(self.n, self.d) for array in arrays)


def _run(
    table: _Table,
    grad: Any,
    steps: NDArray[np.int32],
    lr: Any,
    settings: tuple[float, float, float],
    rows: tuple[NDArray[np.int64] | None, NDArray[np.uint8] | None],
) -> None:
    beta1, beta2, eps = settings
    for beta in (beta1, beta2):
        if not 0.0 <= beta < 1.0:
            refuse_value(f"betas: expected numbers in [0, 1), got {beta!r}")
    if not (eps >= 0.0 and math.isfinite(eps)):
        refuse_value(f"eps: expected a finite number >= 0, got {eps!r}")
    ids, mask = rows
    count = table.n if ids is None or as_array("grad", grad).shape[:1] == (table.n,) else len(ids)
    gradient = native_array("grad", grad, np.float32, (count, *table.shape[1:])).reshape(count, table.d)
    common, per_column, per_row = _rates(lr, table.n, table.d)
    bad = _native.adam_update(
        table.param, gradient, table.exp_avg, table.exp_avg_sq, steps, ids, mask,
        common, per_column, per_row, beta1, beta2, eps, True,
    )  # fmt: skip
    if bad >= 0:
        row, column = divmod(bad, table.d)
        refuse(f"grad: expected finite values up to 1e18, got {gradient[row, column]} in row {row}, column {column}; "
               "nothing was changed. Look for the loss or the render that produced it")  # fmt: skip


def _rows(rows: Any | None, n: int) -> tuple[NDArray[np.int64] | None, NDArray[np.uint8] | None]:
    if rows is None:
        return None, None
    array = as_array("rows", rows)
    if array.dtype == np.bool_:
        return None, native_array("rows", array, np.bool_, (n,)).view(np.uint8)
    ids = native_array("rows", array, np.int64, ("ids",))
    if len(ids) and (ids[0] < 0 or ids[-1] >= n or bool((np.diff(ids) <= 0).any())):
        refuse(f"rows: expected strictly increasing ids from 0 to {n - 1}, got {ids[:8].tolist()}... ; sort them and "
               "drop duplicates (numpy.unique)")  # fmt: skip
    return ids, None


def _rates(lr: Any, n: int, d: int) -> tuple[float, Float32 | None, Float32 | None]:
    """Split lr into (number, per column, per row)."""
    if isinstance(lr, int | float):
        if not (lr >= 0.0 and math.isfinite(lr)):
            refuse_value(f"lr: expected a finite number >= 0, got {lr!r}")
        return float(lr), None, None
    array = as_array("lr", lr)
    if not (np.isfinite(array).all() and (array >= 0).all()):
        refuse_value("lr: expected finite rates >= 0, got some that are not")
    if n == d and array.shape == (n,):
        refuse(f"lr: rates per row or per column? n = d = {n}; give shape [{n}, 1] or [1, {d}]")
    rates = native_array("lr", array, np.float32, array.shape).reshape(-1)
    if array.shape in ((n,), (n, 1)):
        return 1.0, None, rates
    if array.shape in ((d,), (1, d)):
        return 1.0, rates, None
    refuse(f"lr: expected a number, [{d}] per column or [{n}] per row, got shape {list(array.shape)}")
