"""Morton keys: three cell coordinates interleaved into one int64; a parent's key is its child's shifted by 3."""

from __future__ import annotations

import torch

#: Bits per axis that fit three times into the 63 usable bits of an int64.
AXIS_BITS = 21
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_GATHER = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x1F0000FF0000FF),
    (16, 0x1F00000000FFFF),
    (32, 0x1FFFFF),
)


def encode(cells: torch.Tensor) -> torch.Tensor:
    """[N, 3] int64 cells in [0, 2^21) -> [N] int64 keys."""
    bits = cells
    for shift, mask in _SPREAD:
        bits = (bits | (bits << shift)) & mask
    return bits[:, 0] | (bits[:, 1] << 1) | (bits[:, 2] << 2)


def decode(keys: torch.Tensor) -> torch.Tensor:
    """[N] keys -> [N, 3] int64 cells; the inverse of :func:`encode`."""
    bits = torch.stack([keys, keys >> 1, keys >> 2], 1) & 0x1249249249249249
    for shift, mask in _GATHER:
        bits = (bits | (bits >> shift)) & mask
    return bits
