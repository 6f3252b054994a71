"""The transformation cache: a hash grid of many resolutions (Müller et al. 2022) and a small network, in torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from gsstream.api import Field, FieldShape, FloatArray, IntArray

#: Value of one unit of the packet's whole numbers, of an entry and of a weight.
ENTRY_UNIT, WEIGHT_UNIT = 2.0**-20, 2.0**-14
BETAS, EPSILON = (0.9, 0.999), 1e-8


class Lookup:
    """Where positions lie in the grids: entries and weights, which stay while the cache is trained."""

    def __init__(self, shape: FieldShape, unit: FloatArray) -> None:
        """Prepare the look-up."""
        from scipy.sparse import csr_array

        #: For each level the entries that some position is interpolated from, ascending: only these are trained.
        self.touched = shape.touched(unit)
        places, nears, first = [], [], 0
        for level, which in enumerate(self.touched):
            index, near = shape.corners(unit, level)
            places.append((first + np.searchsorted(which, index.T)).astype(np.int32))
            nears.append(near.T.astype(np.float32))
            first += len(which)
        place, weight = (np.stack(parts, 1).reshape(-1) for parts in (places, nears))
        ends = np.arange(0, len(place) + 1, 8, dtype=np.int32)
        #: [A L, E] weights of the trained entries, eight in a row.
        self.matrix = csr_array((weight, place, ends), shape=(len(ends) - 1, first))


class _Interpolated(torch.autograd.Function):
    """Table [E, F] -> [A L, F], by sparse matrices: the backward of torch's own look-up sorts all places every time."""

    @staticmethod
    def forward(ctx: Any, table: torch.Tensor, lookup: Lookup) -> torch.Tensor:
        ctx.matrix = lookup.matrix
        return torch.from_numpy(lookup.matrix @ table.detach().numpy())

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.from_numpy(ctx.matrix.T @ grads[0].numpy()), None


class Cache:
    """Position -> shift [A, 3], in units of its reach, and turn [A, 3], axis * tan(angle / 2). At first: no motion.

    Entries of the grid and layers of the network are trained by :meth:`step`, from where every player begins.
    """

    def __init__(self, shape: FieldShape, lookup: Lookup, entry_step: float, weight_step: float) -> None:
        """Begin at rest."""
        self.shape, self.lookup = shape, lookup
        self.entry_step = max(1, round(entry_step / ENTRY_UNIT))
        self.weight_step = max(1, round(weight_step / WEIGHT_UNIT))
        entries = [shape.start_entries(level, which) for level, which in enumerate(lookup.touched)]
        starts = [(np.concatenate(entries), ENTRY_UNIT, self.entry_step)]
        starts += [(layer, WEIGHT_UNIT, self.weight_step) for layer in shape.start_weights()]
        self.starts = [torch.from_numpy((start * unit).astype(np.float32)) for start, unit, _ in starts]
        self.steps = [unit * step for _, unit, step in starts]
        self.learned = [nn.Parameter(torch.zeros_like(start)) for start in self.starts]
        self._moments = [(torch.zeros_like(start), torch.zeros_like(start)) for start in self.starts]
        self._count = 0

    def symbols(self) -> list[torch.Tensor]:
        """Return the learned changes in whole quantisation steps: of the table, then of each layer."""
        return [(value.detach() / step).round() for value, step in zip(self.learned, self.steps, strict=True)]

    def __call__(self, rounded: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """Return shifts and turns of the positions."""
        learned: list[torch.Tensor] = list(self.learned)
        if rounded:
            sent = [symbols * step for symbols, step in zip(self.symbols(), self.steps, strict=True)]
            learned = [value + (said - value).detach() for value, said in zip(learned, sent, strict=True)]
        table, *layers = (start + value for start, value in zip(self.starts, learned, strict=True))
        found: torch.Tensor = _Interpolated.apply(table, self.lookup)  # type: ignore[no-untyped-call]
        values = found.view(-1, self.shape.widths[0])
        for number, layer in enumerate(layers):
            values = values @ layer
            if number + 1 < len(layers):
                values = values.relu()
        # A quaternion (1 + a, b): its turn is b / (1 + a).
        return values[:, :3], values[:, 4:] / (1 + values[:, 3:4]).clamp_min(0.1)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Make one step of Adam with the gradients there are, and forget them."""
        self._count += 1
        for value, (first, second) in zip(self.learned, self._moments, strict=True):
            if value.grad is None:
                continue
            first.lerp_(value.grad, 1 - BETAS[0])
            second.mul_(BETAS[1]).addcmul_(value.grad, value.grad, value=1 - BETAS[1])
            scale = (second / (1 - BETAS[1] ** self._count)).sqrt_().add_(EPSILON)
            value.addcdiv_(first, scale, value=-rate / (1 - BETAS[0] ** self._count))
            value.grad = None

    def field(self, marks: IntArray | None) -> Field:
        """Return the change of a frame with the learned weights."""
        table, *layers = (symbols.numpy().astype(np.int32) for symbols in self.symbols())
        ends = np.cumsum([len(which) for which in self.lookup.touched])[:-1]
        entries = tuple(np.split(table, ends))
        return Field(self.shape, marks, entries, tuple(layers), self.entry_step, self.weight_step)
