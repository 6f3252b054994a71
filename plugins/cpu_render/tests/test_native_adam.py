"""The fused Adam against torch and against per-row Adam in float64."""

from typing import Any

import numpy as np
import pytest
import torch
from gsstream_cpu_render.adam import adam_rows
from numpy.typing import NDArray

from gsstream.api import InputError, ShapeError

Table = NDArray[Any]


class RowEdit:
    """Adam written per row in float64."""

    def __init__(self, param: Table) -> None:
        self.param = param.astype(np.float64)
        self.m, self.v = np.zeros_like(self.param), np.zeros_like(self.param)
        self.t = np.zeros(len(param), np.int64)

    def update(self, grad: Table, touched: Table, lr: Any, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        for row in np.flatnonzero(touched):
            g = grad[row].astype(np.float64)
            self.t[row] += 1
            self.m[row] += (1 - betas[0]) * (g - self.m[row])
            self.v[row] += (1 - betas[1]) * (g * g - self.v[row])
            first = self.m[row] / (1 - betas[0] ** self.t[row])
            second = self.v[row] / (1 - betas[1] ** self.t[row])
            rate = lr[row] if isinstance(lr, np.ndarray) and lr.shape == (len(self.param), 1) else lr
            self.param[row] -= rate * first / (np.sqrt(second) + 1e-15)


def fresh(param: Table) -> dict[str, Any]:
    zeros = np.zeros_like(param)
    return {"param": param.copy(), "exp_avg": zeros, "exp_avg_sq": zeros.copy(), "step": np.zeros(len(param), np.int32)}


@pytest.mark.parametrize("d", [1, 3, 4, 16, 45])
def test_all_rows_equal_torch_in_float64(isa: str, d: int) -> None:
    rng = np.random.default_rng(d)
    start = rng.standard_normal((37, d)).astype(np.float32)
    reference = torch.nn.Parameter(torch.tensor(start, dtype=torch.float64))
    optimizer = torch.optim.Adam([reference], lr=0.01, betas=(0.8, 0.99), eps=1e-8)
    rows = fresh(start)
    for _ in range(50):
        grad = rng.standard_normal(start.shape).astype(np.float32)
        reference.grad = torch.tensor(grad, dtype=torch.float64)
        optimizer.step()
        adam_rows(grad=grad, lr=0.01, betas=(0.8, 0.99), eps=1e-8, **rows)
    wanted = reference.detach().numpy()
    assert (rows["step"] == 50).all()
    np.testing.assert_allclose(rows["param"], wanted, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", ["mask", "ids", "compact ids"])
@pytest.mark.parametrize("d", [1, 3, 24])
def test_irregularly_touched_rows(kind: str, d: int) -> None:
    rng = np.random.default_rng(d)
    start = rng.standard_normal((61, d)).astype(np.float32)
    reference, mine = RowEdit(start), fresh(start)
    for _ in range(50):
        grad = (rng.standard_normal(start.shape) * 10.0 ** rng.integers(-6, 2)).astype(np.float32)
        touched = rng.random(61) < rng.choice([0.0, 0.1, 0.5, 1.0])
        reference.update(grad, touched, 0.01)
        ids = np.flatnonzero(touched)
        if kind == "mask":
            adam_rows(grad=grad, rows=touched, lr=0.01, **mine)
        elif kind == "ids":
            adam_rows(grad=grad, rows=ids, lr=0.01, **mine)
        else:
            adam_rows(grad=grad[ids], rows=ids, lr=0.01, **mine)
    np.testing.assert_array_equal(mine["step"], reference.t)
    np.testing.assert_allclose(mine["param"], reference.param, rtol=0, atol=3e-6)
    np.testing.assert_allclose(mine["exp_avg"], reference.m, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("shape", ["column", "row", "square column", "square row"])
def test_rates_by_column_or_row(shape: str) -> None:
    rng = np.random.default_rng(5)
    n, d = (6, 6) if "square" in shape else (40, 6)
    start = rng.standard_normal((n, d)).astype(np.float32)
    by_row = "row" in shape
    rates = (rng.random((n, 1) if by_row else (1, d)) * 0.1).astype(np.float32)
    reference, mine = RowEdit(start), fresh(start)
    for _ in range(10):
        grad = rng.standard_normal(start.shape).astype(np.float32)
        reference.update(grad, np.ones(n), rates if by_row else rates[0])
        adam_rows(grad=grad, lr=rates if "square" in shape else rates.reshape(-1), **mine)
    np.testing.assert_allclose(mine["param"], reference.param, rtol=0, atol=2e-6)


def test_tensors_and_higher_ranks_share_memory() -> None:
    param = torch.zeros(5, 2, 3, requires_grad=True)
    state = {"exp_avg": torch.zeros(5, 2, 3), "exp_avg_sq": torch.zeros(5, 2, 3)}
    step = torch.zeros(5, dtype=torch.int32)
    rows = torch.tensor([True, False, True, False, False])
    adam_rows(param, torch.ones(5, 2, 3), step=step, lr=0.5, rows=rows, **state)
    assert torch.allclose(param[rows], torch.tensor(-0.5))
    assert not param[~rows].any()
    assert step.tolist() == [1, 0, 1, 0, 0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("compact", [False, True])
def test_a_bad_gradient_changes_nothing(value: float, compact: bool) -> None:
    mine = fresh(np.ones((3000, 7), np.float32))
    before = {name: array.copy() for name, array in mine.items()}
    grad = np.ones((3000, 7), np.float32)
    grad[2999, 6] = value
    rows = np.arange(2000, 3000) if compact else None
    place = "row 999" if compact else "row 2999"
    with pytest.raises(ShapeError, match=f"{place}, column 6"):
        adam_rows(grad=grad[2000:] if compact else grad, rows=rows, lr=0.01, **mine)
    for name, array in mine.items():
        np.testing.assert_array_equal(array, before[name])
    # A bad value in a row that is not touched is nobody's business.
    adam_rows(grad=grad, rows=np.arange(10), lr=0.01, **mine)
    assert mine["step"].sum() == 10


def _arguments(**changes: Any) -> dict[str, Any]:
    return fresh(np.ones((4, 3), np.float32)) | {"grad": np.ones((4, 3), np.float32), "lr": 0.1} | changes


SHARED = np.ones((4, 3), np.float32)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (_arguments(grad=np.ones((4, 2), np.float32)), "grad: expected shape"),
        (_arguments(grad=np.ones((4, 3))), "grad: expected dtype float32"),
        (_arguments(param=np.ones((3, 4), np.float32).T), "param: expected a contiguous"),
        (_arguments(param=SHARED, exp_avg=SHARED), "memory of its own"),
        (_arguments(step=np.zeros(4, np.int64)), "step: expected dtype int32"),
        (_arguments(step=np.zeros(5, np.int32)), "step: expected shape"),
        (_arguments(rows=np.array([1, 1])), "strictly increasing"),
        (_arguments(rows=np.array([2, 1])), "strictly increasing"),
        (_arguments(rows=np.array([-1])), "strictly increasing"),
        (_arguments(rows=np.array([4])), "strictly increasing"),
        (_arguments(rows=np.ones(3, bool)), "rows: expected shape"),
        (_arguments(lr=np.ones(5, np.float32)), "lr: expected a number"),
    ],
)
def test_wrong_arrays_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        adam_rows(**arguments)


@pytest.mark.parametrize(
    "change",
    [
        {"lr": -1.0},
        {"lr": float("nan")},
        {"lr": np.full(3, -1, np.float32)},
        {"betas": (1.0, 0.999)},
        {"betas": (0.9, -0.1)},
        {"eps": -1.0},
    ],
)
def test_wrong_settings_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        adam_rows(**_arguments(**change))
