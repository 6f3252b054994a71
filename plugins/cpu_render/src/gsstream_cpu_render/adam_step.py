"""One step of the native Adam on one table of tensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gsstream.backend import ADAM_BETAS, ADAM_EPS, AdamState
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import native_array, refuse, refuse_value


def step_table(
    name: str, value: torch.Tensor, gradient: torch.Tensor, state: AdamState, lr: float | torch.Tensor
) -> None:
    """Move one table ``value`` [n, ...] and its moments by its gradient; see ``gsstream.backend.RowOptimiser.step``."""
    if gradient.shape != value.shape:
        refuse(f"gradient of {name}: expected shape {list(value.shape)}, got {list(gradient.shape)}")
    if value.numel() == 0:
        return
    rows = len(value)
    # The kernel checks shape, dtype and layout again; here are only the checks whose messages can name the table.
    rates = _rates(name, lr, (rows, value.numel() // rows))
    table = [part.numpy().reshape(rows, -1) for part in (value, gradient.detach().contiguous())]
    moments = [part.numpy().reshape(rows, -1) for part in (state.exp_avg, state.exp_avg_sq)]
    try:
        bad = _native.adam_update(*table, *moments, state.steps.numpy(), *rates, *ADAM_BETAS, ADAM_EPS, state.ahead)
    except (TypeError, ValueError) as error:
        for label, tensor in (("values", value), ("gradient", gradient), ("exp_avg", state.exp_avg)):
            native_array(f"{label} of {name}", tensor, table[0].dtype.type, tuple(value.shape))
        refuse_value(f"{name}: {error}")
    if bad >= 0:
        row, column = divmod(bad, table[1].shape[1])
        got = f"{table[1][row, column]} in row {row}, column {column}"
        refuse(f"gradient of {name}: expected finite values up to 1e18, got {got}; its table was not changed")


def _rates(
    name: str, lr: float | torch.Tensor, shape: tuple[int, ...]
) -> tuple[float, NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """(number, by column, by row), as the kernel takes them."""
    if not isinstance(lr, torch.Tensor):
        return lr, None, None
    if lr.shape == shape[1:]:
        return 1.0, lr.numpy(), None
    if lr.shape == (shape[0], 1):
        return 1.0, None, lr[:, 0].numpy()
    refuse(f"learning rates of {name}: expected [{shape[1]}] by column or [{shape[0]}, 1] by row, got {list(lr.shape)}")
