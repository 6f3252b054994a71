"""The loss and the row optimiser of a GPU, a kernel or two each where torch takes dozens of operations.

The kernels are written in Triton, which torch's CUDA builds for Linux bring. Without it loss and optimiser are those of
the reference, in torch on the GPU: the same numbers up to rounding, from more launches.
"""

from __future__ import annotations

import functools
import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import torch

from gsstream.backend import AdamState, Loss
from gsstream.replay import Recorder, ReplayedAdam


@dataclass(frozen=True, slots=True)
class Fused:
    """Functions of one launch each, with the signatures of ``loss.py`` and ``adam.py``."""

    loss_by_tile: Callable[..., Any]
    gradient_by_pixel: Callable[..., Any]
    move_table: Callable[..., Any]


@functools.cache
def load_fused(device: str) -> Fused | None:
    """Return the kernels in Triton, proven to run on ``device``; None where Triton is missing or cannot compile them.

    Triton compiles when a kernel is first called, in seconds, and keeps what it compiled for the next process.
    """
    if importlib.util.find_spec("triton") is None:
        return None
    from gsstream_gsplat_render.adam import move_table
    from gsstream_gsplat_render.loss import gradient_by_pixel, loss_by_tile

    image, mask = torch.zeros(16, 16, 3, device=device), torch.ones(1, 1, dtype=torch.bool, device=device)
    steps, corrections = torch.ones(1, dtype=torch.int32, device=device), torch.ones(2, 2, device=device)
    try:
        for tiles in (None, mask):
            _, by_window = loss_by_tile(image, image.byte(), 0.2, tiles)
            gradient_by_pixel(image, image.byte(), by_window, 0.2, tiles)
        for lr in (0.1, image[0, 0]):
            move_table(image[0, :1], image[1, :1], image[2, :1], image[3, :1], steps, corrections, lr)
    except Exception as error:  # compilers and drivers of strangers fail in any way
        warnings.warn(
            f"loss and Adam run in torch's own operations, because Triton's kernels do not run on {device} "
            f"({type(error).__name__}: {error}). Triton needs a C compiler and Python's headers (Debian: python3-dev)",
            stacklevel=2,
        )
        return None
    return Fused(loss_by_tile, gradient_by_pixel, move_table)


@final
class FusedLoss(Loss):
    """(1 - w) L1 + w (1 - SSIM), 3DGS variant; equal to the reference up to rounding.

    What it needs to know of a target takes less time to compute than to read, so a target waits as it came: three bytes
    a pixel.
    """

    def __init__(self, fused: Fused) -> None:
        self._fused = fused

    def prepare(self, target: torch.Tensor) -> Any:
        return target.detach().contiguous()

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        image = image.detach()
        by_tile, by_window = self._fused.loss_by_tile(image, prepared, dssim, tile_mask)
        value = by_tile.sum(dtype=torch.float64) / image.numel()
        return value, self._fused.gradient_by_pixel(image, prepared, by_window, dssim, tile_mask)


@final
class FusedAdam(ReplayedAdam):
    """Recorded and replayed as its base is; a table is moved by one kernel.

    Arguments:
        recorder: of the device; None: nothing is recorded.
    """

    def __init__(self, fused: Fused, recorder: Recorder | None) -> None:
        super().__init__(recorder)
        self._fused = fused

    def move(
        self,
        value: torch.Tensor,
        gradient: torch.Tensor,
        state: AdamState,
        corrections: torch.Tensor,
        lr: float | torch.Tensor,
    ) -> None:
        moments = (state.exp_avg, state.exp_avg_sq, state.steps)
        self._fused.move_table(value, gradient, *moments, corrections, lr)
