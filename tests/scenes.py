"""Scenes that tests of several folders share."""

from __future__ import annotations

import numpy as np

from gsstream.core.gaussians import ATTRIBUTES, Gaussians


def make_scene(number: int, bases: int = 4, seed: int = 0) -> Gaussians[np.ndarray]:
    """Gaussians whose raw values are all drawn from N(0, 1), float32."""
    g = np.random.default_rng(seed)
    shapes = [(number, 3), (number, 4), (number, 3), (number,), (number, 1, 3), (number, bases - 1, 3)]
    return Gaussians(**{k: g.normal(size=s).astype(np.float32) for k, s in zip(ATTRIBUTES, shapes, strict=True)})
