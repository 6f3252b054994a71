"""The fused Adam against torch and against Adam written per row in float64, on every instruction set."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gsstream_cpu_render.adam_step import step_table

from gsstream.api import InputError, ShapeError
from gsstream.backend import ADAM_BETAS, ADAM_EPS, AdamState


def drawn(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    return torch.from_numpy(rng.standard_normal(shape).astype(np.float32))


def by_hand(
    value: np.ndarray, m: np.ndarray, v: np.ndarray, t: np.ndarray, grad: np.ndarray, lr: Any, ahead: bool
) -> None:
    """One step (Kingma and Ba 2015, algorithm 1) of rows that have taken ``t`` steps each, in place.

    One that looks ahead goes by the mean that would follow if the gradient came once more.
    """
    t += 1
    m += (1 - ADAM_BETAS[0]) * (grad - m)
    v += (1 - ADAM_BETAS[1]) * (grad * grad - v)
    next_mean = m + (1 - ADAM_BETAS[0]) * (grad - m)
    first = (next_mean if ahead else m) / (1 - ADAM_BETAS[0] ** (t[:, None] + ahead))
    second = v / (1 - ADAM_BETAS[1] ** t[:, None])
    value -= lr * first / (np.sqrt(second) + ADAM_EPS)


@pytest.mark.parametrize("d", [1, 3, 4, 16, 45])
def test_all_rows_equal_torch_in_float64(isa: str, d: int) -> None:
    rng = np.random.default_rng(d)
    start = drawn(rng, 37, d)
    reference = torch.nn.Parameter(start.double())
    optimizer = torch.optim.Adam([reference], lr=0.01, betas=ADAM_BETAS, eps=ADAM_EPS)
    value, state = start.clone(), AdamState.start(start)
    for _ in range(50):
        gradient = drawn(rng, 37, d)
        reference.grad = gradient.double()
        optimizer.step()
        step_table("means", value, gradient, state, 0.01)
    assert (state.steps == 50).all()
    np.testing.assert_allclose(value, reference.detach(), rtol=0, atol=2e-6)


@pytest.mark.parametrize("ahead", [False, True])
@pytest.mark.parametrize("rates", ["number", "by column", "by row"])
@pytest.mark.parametrize("d", [1, 3, 24, 61])
def test_rows_of_any_age_and_rates_of_any_kind(isa: str, rates: str, d: int, ahead: bool) -> None:
    """Neighbours of one age form one long row in the kernel: here some do, some do not."""
    rng = np.random.default_rng(d)
    value, state = drawn(rng, 61, d), AdamState.start(torch.zeros(61, d), ahead)
    state.steps.copy_(torch.from_numpy(np.repeat(rng.integers(0, 400, 21), 3)[:61].astype(np.int32)))
    state.exp_avg.copy_(0.1 * drawn(rng, 61, d))
    state.exp_avg_sq.copy_(0.1 * drawn(rng, 61, d).abs())
    shape = {"number": (), "by column": (d,), "by row": (61, 1)}[rates]
    lr = 0.01 if shape == () else 0.1 * torch.from_numpy(rng.random(shape).astype(np.float32))
    wanted, m, v = (part.numpy().astype(np.float64) for part in (value, state.exp_avg, state.exp_avg_sq))
    t = state.steps.numpy().astype(np.int64)
    for _ in range(20):
        gradient = drawn(rng, 61, d) * 10.0 ** int(rng.integers(-6, 2))
        by_hand(wanted, m, v, t, gradient.numpy().astype(np.float64), lr if shape == () else lr.numpy(), ahead)
        step_table("means", value, gradient, state, lr)
    np.testing.assert_array_equal(state.steps, t)
    np.testing.assert_allclose(value, wanted, rtol=0, atol=1e-5)
    np.testing.assert_allclose(state.exp_avg, m, rtol=1e-5, atol=1e-6)


def test_tables_of_any_rank_and_of_nothing() -> None:
    value, state = torch.zeros(5, 2, 3), AdamState.start(torch.zeros(5, 2, 3))
    step_table("shN", value, torch.ones(5, 2, 3), state, 0.5)
    assert torch.allclose(value, torch.tensor(-0.5))
    step_table("shN", torch.zeros(0, 3), torch.zeros(0, 3), AdamState.start(torch.zeros(0, 3)), 0.5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 2e18])
def test_a_bad_gradient_changes_nothing(isa: str, bad: float) -> None:
    value, gradient = torch.ones(3000, 7), torch.ones(3000, 7)
    gradient[2999, 6] = bad
    state = AdamState.start(value)
    with pytest.raises(ShapeError, match=r"gradient of means: .* in row 2999, column 6; its table was not changed"):
        step_table("means", value, gradient, state, 0.01)
    assert bool((value == 1).all())
    assert not state.exp_avg.any()
    assert not state.steps.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gradient": torch.ones(4, 2)}, "gradient of means: expected shape"),
        ({"gradient": torch.ones(4, 3).double()}, "gradient of means: expected dtype float32"),
        ({"value": torch.ones(3, 4).T}, "values of means: expected a contiguous"),
        ({"lr": torch.ones(5)}, "learning rates of means: expected"),
    ],
)
def test_wrong_tables_are_refused(change: dict[str, Any], message: str) -> None:
    given = {"value": torch.ones(4, 3), "gradient": torch.ones(4, 3), "lr": 0.1} | change
    with pytest.raises((ShapeError, InputError), match=message):
        step_table("means", given["value"], given["gradient"], AdamState.start(torch.ones(4, 3)), given["lr"])
