"""Named random streams derived from (seed, name, frame): resuming needs no stored generator state.

The global generators of python, numpy and torch are never touched. Adding a part never changes another's numbers.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, slots=True)
class Rng:
    """A source of independent generators. ``seed`` is any non-negative integer."""

    seed: int

    def key(self, name: str, frame: int) -> int:
        """Return a key of 63 bits for (seed, name, frame), stable across machines and versions."""
        digest = hashlib.blake2b(f"{self.seed}/{name}/{frame}".encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little") >> 1

    def stream(self, name: str, frame: int = 0) -> torch.Generator:
        """Return a fresh CPU torch generator for this name and frame."""
        import torch

        return torch.Generator(device="cpu").manual_seed(self.key(name, frame))

    def numpy(self, name: str, frame: int = 0) -> np.random.Generator:
        """Return a fresh numpy generator for this name and frame."""
        return np.random.default_rng(self.key(name, frame))
