"""How many Gaussians frame 0 may have: the bound by pixels and the cap."""

from __future__ import annotations

from typing import Any

import numpy as np
from test_encoder import TINY, WORLD, frames

from gsstream.core.gaussians import Gaussians
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.how_many import most_gaussians
from gsstream.packet import decode_packet
from gsstream.recipe.model import FirstFrame


def fitted(**settings: Any) -> Gaussians[np.ndarray]:
    """Frame 0 of the small world."""
    with open_recording(WORLD) as source:
        packet = encoder_for("s2gs-edge", source, {**TINY, **settings}).encode(frames()[0]).packet
    return decode_packet(None, packet.data).gaussians


def test_the_bound_by_pixels_is_below_the_cap_or_the_cap() -> None:
    frame = frames()[0]
    pixels = 3 * 32 * 24
    assert most_gaussians(FirstFrame(), frame) == 60_000
    assert most_gaussians(FirstFrame(pixels_per_gaussian=10), frame) == pixels // 10
    assert most_gaussians(FirstFrame(pixels_per_gaussian=10, max_gaussians=50), frame) == 50
    assert most_gaussians(FirstFrame(pixels_per_gaussian=1e9), frame) == 1


def test_a_run_keeps_to_both() -> None:
    growing = {"first_frame.max_iterations": 60, "first_frame.densify_from": 10, "first_frame.densify_every": 5}
    plain = {**growing, "first_frame.densify_gradient": 1e-6}
    free, bound = fitted(**plain), fitted(**plain, **{"first_frame.pixels_per_gaussian": 8.0})
    assert len(bound) <= 3 * 32 * 24 // 8 < len(free)
