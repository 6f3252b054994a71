"""What a GPU computes in a kernel or two where torch takes dozens of operations: loss, row optimiser, lists of tiles.

The kernels are written in Triton, which torch's CUDA builds for Linux bring. Without it everything is in torch on the
GPU: the same numbers up to rounding, from more launches.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import torch

from gsstream.api import AnalyticGate, AnalyticPenalty, ShapeError
from gsstream.backend import AdamState, Loss
from gsstream.replay import Recorder, ReplayedAdam
from gsstream_gsplat_render.placed import RowKernels
from gsstream_gsplat_render.tiles import Grid, TileKernels, tile_lists


@dataclass(frozen=True, slots=True)
class Fused:
    """Functions of one launch each, with the signatures of ``loss.py``, ``adam.py``, ``rate.py``, ``gates.py``,
    ``rows.py`` and ``tiles.py``.

    ``device``: the type of the device that they run on. What lies elsewhere is computed as the reference does it.
    """

    device: str
    loss_by_tile: Callable[..., Any]
    gradient_by_pixel: Callable[..., Any]
    move_table: Callable[..., Any]
    sum_symbols: Callable[..., Any]
    add_rate: Callable[..., Any]
    open_gates: Callable[..., Any]
    gate_gradients: Callable[..., Any]
    rows: RowKernels
    tiles: TileKernels

    def serves(self, tensor: torch.Tensor) -> bool:
        """Say whether the kernels can be given this tensor."""
        return tensor.device.type == self.device


@functools.cache
def load_fused(device: str) -> Fused | None:
    """Return the kernels in Triton, proven to run on ``device``; None where Triton is missing or cannot compile them.

    Triton compiles when a kernel is first called, in seconds, and keeps what it compiled for the next process.
    """
    if importlib.util.find_spec("triton") is None:
        return None
    from gsstream_gsplat_render import boxes
    from gsstream_gsplat_render.adam import move_table
    from gsstream_gsplat_render.gates import gate_gradients, open_gates
    from gsstream_gsplat_render.loss import gradient_by_pixel, loss_by_tile
    from gsstream_gsplat_render.rate import add_rate, sum_symbols
    from gsstream_gsplat_render.rows import put_rows, take_rows

    image, mask = torch.zeros(16, 16, 3, device=device), torch.ones(1, 1, dtype=torch.bool, device=device)
    steps, corrections = torch.ones(1, dtype=torch.int32, device=device), torch.ones(2, 3, device=device)
    try:
        for tiles in (None, mask):
            _, by_window = loss_by_tile(image, image.byte(), 0.2, tiles)
            gradient_by_pixel(image, image.byte(), by_window, 0.2, tiles)
        for lr, ahead in ((0.1, False), (image[0, 0], True)):
            move_table(image[0, :1], image[1, :1], image[2, :1], image[3, :1], steps, corrections, lr, ahead)
            sums = sum_symbols(image[5], corrections.flatten()[:3])
            add_rate(image[4], image[5], corrections.flatten()[:3], image[6, :, 0], sums, lr)
        rows = torch.zeros(2, dtype=torch.int64, device=device)
        opened, slopes = open_gates(image[7, 0], rows, 1.0, 0.0, 1)
        gate_gradients(opened, slopes, image[8, :2], image[7, 0], rows, 0.0, 1.0, 1.0)
        tables = [torch.zeros(2, *size, device=device) for size in ((3,), (4,), (3,), (), (1, 3), (3, 3))]
        put_rows(rows[:1], *take_rows(rows[:1], *tables), *tables)
        lists = TileKernels(boxes.find_boxes, boxes.count_entries, boxes.list_entries, boxes.cover_tiles)
        _try_tiles(lists, torch.device(device))
    except Exception as error:  # compilers and drivers of strangers fail in any way
        warnings.warn(
            "loss, Adam, rate and lists of tiles run in torch's own operations, because Triton's kernels do not run on "
            f"{device} ({type(error).__name__}: {error}). Triton needs a C compiler and Python's headers (Debian: "
            "python3-dev)",
            stacklevel=2,
        )
        return None
    return Fused(
        device=torch.device(device).type,
        loss_by_tile=loss_by_tile,
        gradient_by_pixel=gradient_by_pixel,
        move_table=move_table,
        sum_symbols=sum_symbols,
        add_rate=add_rate,
        open_gates=open_gates,
        gate_gradients=gate_gradients,
        rows=RowKernels(put_rows, take_rows),
        tiles=lists,
    )


def _try_tiles(kernels: TileKernels, device: torch.device) -> None:
    """Make lists of one Gaussian."""
    grid = Grid(1, 1, capacity=1, device=device, kernels=kernels)
    means2d, radii = torch.full((1, 2), 8.0, device=device), torch.ones(1, 2, dtype=torch.int32, device=device)
    found, _ = grid.boxes(means2d, radii)
    rows = torch.zeros(1, dtype=torch.int64, device=device)
    tile_lists(rows.float(), found, grid)
    grid.covered(found, rows)


@final
class FusedLoss(Loss):
    """(1 - w) L1 + w (1 - SSIM), 3DGS variant; equal to the reference up to rounding.

    What it needs to know of a target takes less time to compute than to read, so a target waits as it came: three bytes
    a pixel.

    Arguments:
        reference: of what lies on another device.
    """

    def __init__(self, fused: Fused, reference: Loss) -> None:
        self._fused, self._reference = fused, reference

    def prepare(self, target: torch.Tensor) -> Any:
        return target.detach().contiguous() if self._fused.serves(target) else self._reference.prepare(target)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        image = image.detach()
        if not self._fused.serves(image):
            return self._reference.evaluate(image, prepared, dssim, tile_mask)
        by_tile, by_window = self._fused.loss_by_tile(image, prepared, dssim, tile_mask)
        value = by_tile.sum(dtype=torch.float64) / image.numel()
        return value, self._fused.gradient_by_pixel(image, prepared, by_window, dssim, tile_mask)


@final
class FusedAdam(ReplayedAdam):
    """Recorded and replayed as its base is; a table is moved by one kernel, and two find what bits cost.

    Arguments:
        recorder: of the device; None: nothing is recorded.
    """

    def __init__(self, fused: Fused, recorder: Recorder | None) -> None:
        super().__init__(recorder)
        self._fused = fused

    def looks(self, value: torch.Tensor) -> bool:
        return self._fused.serves(value)

    def move(
        self,
        value: torch.Tensor,
        gradient: torch.Tensor,
        state: AdamState,
        corrections: torch.Tensor,
        lr: float | torch.Tensor,
    ) -> torch.Tensor | None:
        if not self._fused.serves(value):
            return super().move(value, gradient, state, corrections, lr=lr)
        moments = (state.exp_avg, state.exp_avg_sq, state.steps)
        is_well: torch.Tensor = self._fused.move_table(value, gradient, *moments, corrections, lr, ahead=state.ahead)
        return is_well

    def add_rate(
        self,
        gradient: torch.Tensor,
        latents: torch.Tensor,
        steps: torch.Tensor,
        gates: torch.Tensor,
        weight: float | torch.Tensor,
    ) -> None:
        if not self._fused.serves(latents):
            super().add_rate(gradient, latents, steps, gates=gates, weight=weight)
        elif latents.numel():
            sums = self._fused.sum_symbols(latents, steps)
            self._fused.add_rate(gradient, latents, steps, gates, sums, weight)

    def known_gates(self, gates: Any) -> Any:
        if not self._fused.serves(gates.logits):
            return gates
        match gates.gate.form(), gates.regularizer.form():
            case AnalyticGate() as form, AnalyticPenalty() as penalty:
                return FusedGates(gates, form, penalty, fused=self._fused, optimiser=self)
            case _:
                return gates


@final
class FusedGates:
    """Gates whose gate and penalty are known in closed form: no graph is built for them.

    Arguments:
        gates: whose logits, rows and Adam state these are.
        form, penalty: of their parts.
        fused: the kernels. optimiser: moves the logits.
    """

    def __init__(
        self, gates: Any, form: AnalyticGate, penalty: AnalyticPenalty, *, fused: Fused, optimiser: FusedAdam
    ) -> None:
        self._form, self._penalty, self._fused, self._optimiser = form, penalty, fused, optimiser
        self.gate, self.regularizer = gates.gate, gates.regularizer
        self.logits, self.state, self.lr = gates.logits, gates.state, gates.lr
        self.node_of, self.num_gaussians = gates.node_of, gates.num_gaussians

    def noise(self) -> torch.Tensor | None:
        return None  # a closed form has none

    def sample(self, noise: torch.Tensor | None, frozen: torch.Tensor | None) -> torch.Tensor:
        if noise is not None or frozen is not None:
            raise ShapeError("gates in closed form: expected no noise and no row that waits, got one")
        form, logits = self._form, self.logits.detach()
        numbers = form.temperature, form.logit_offset, form.levels
        opened: torch.Tensor
        opened, self._slopes = self._fused.open_gates(logits, self.node_of, *numbers)
        return opened

    def step(
        self, gates: torch.Tensor, by_gate: torch.Tensor, position: torch.Tensor, frozen: torch.Tensor | None
    ) -> None:
        divisor = max(self.num_gaussians, 1) if self._penalty.mean else 1
        weights = self._penalty.open_weight / divisor, self._penalty.displacement_weight / divisor
        logits = self.logits.detach()
        by_logit, by_position = self._fused.gate_gradients(
            by_gate, self._slopes, position.detach(), logits, self.node_of, self._form.open_logit, *weights
        )
        if position.requires_grad and weights[1]:
            torch.autograd.backward([position], [by_position])
        self._optimiser.step({"": logits}, {"": by_logit}, {"": self.state}, {"": self.lr})
        if self._form.bound < math.inf:
            logits.clamp_(-self._form.bound, self._form.bound)
