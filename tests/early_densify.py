"""Densification that begins early, for fits of few iterations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gsstream.engine.fit import constants


@contextmanager
def densifying(begin: int, every: int, gradient: float = constants.DENSIFY_GRADIENT) -> Iterator[None]:
    """In this process Gaussians are added from this iteration of frame 0 on, once in so many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "DENSIFY_FROM", begin)
        patch.setattr(constants, "DENSIFY_EVERY", every)
        patch.setattr(constants, "DENSIFY_GRADIENT", gradient)
        yield
