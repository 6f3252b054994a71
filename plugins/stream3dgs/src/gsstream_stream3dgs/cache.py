"""The transformation cache: a hash grid of many resolutions (Müller et al. 2022) and a small network, in torch."""

from __future__ import annotations

import itertools

import torch
from torch import nn

from gsstream_stream3dgs.settings import CacheSettings

#: One prime for each axis; what a hash grid is usually hashed with.
PRIMES = (1, 2_654_435_761, 805_459_861)
#: Entries are drawn from this range at first.
SPREAD = 1e-4


class Lookup:
    """Where positions lie in the grids: entries and weights, which stay while the weights are trained."""

    def __init__(self, unit: torch.Tensor, settings: CacheSettings) -> None:
        """Prepare the look-up.

        Arguments:
            unit: [A, 3] positions, 0 to 1 along each axis of the box.
            settings: of the cache.
        """
        size = 1 << settings.entries
        indices, weights = [], []
        corners = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
        for level in range(settings.levels):
            cells = int(settings.base * settings.growth**level)
            place = unit.double() * cells
            low = place.floor().clamp(0, cells - 1)
            part = (place - low)[:, None]
            corner = low.long()[:, None] + corners
            near = torch.where(corners.bool(), part, 1 - part)
            if (cells + 1) ** 3 <= size:  # a grid this small has an entry for every corner
                index = (corner[..., 0] * (cells + 1) + corner[..., 1]) * (cells + 1) + corner[..., 2]
            else:
                x, y, z = (corner[..., i] * PRIMES[i] for i in range(3))
                index = (x ^ y ^ z) & (size - 1)
            indices.append(index + level * size)
            weights.append(near.prod(-1).float())
        #: [A, L, 8] entries, and the weight of each.
        self.index, self.weight = torch.stack(indices, 1), torch.stack(weights, 1)


class Cache(nn.Module):
    """Position -> shift [A, 3], in units of its reach, and turn [A, 3], axis * tan(angle / 2). At first: no motion."""

    def __init__(self, settings: CacheSettings, generator: torch.Generator) -> None:
        super().__init__()
        rows = settings.levels << settings.entries
        start = torch.rand(rows, settings.features, generator=generator)
        self.table = nn.Parameter((2 * start - 1) * SPREAD)
        widths = [settings.levels * settings.features, settings.width, settings.width, 7]
        self.layers = nn.ParameterList()
        for inner, outer in itertools.pairwise(widths):
            drawn = torch.randn(inner, outer, generator=generator) * (2 / inner) ** 0.5
            self.layers.append(nn.Parameter(torch.zeros(inner, outer) if outer == 7 else drawn))

    def forward(self, lookup: Lookup) -> tuple[torch.Tensor, torch.Tensor]:
        """Return shifts and turns of the positions of a look-up."""
        found = (self.table[lookup.index] * lookup.weight[..., None]).sum(2)
        values = found.flatten(1)
        for number, layer in enumerate(self.layers):
            values = values @ layer
            if number + 1 < len(self.layers):
                values = values.relu()
        # A quaternion (1 + a, b): its turn is b / (1 + a).
        return values[:, :3], values[:, 4:] / (1 + values[:, 3:4]).clamp_min(0.1)
