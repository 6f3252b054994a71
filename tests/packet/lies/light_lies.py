"""Lights that lie: factors that cannot be, and colours that they lead out of float32."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
from lying import Lies, Victim
from packet_scenes import begin

from gsstream.core.changes import Delta, Light
from gsstream.packet import encode_delta


def light_victim() -> Victim:
    """A light of a scene that is brighter by far than any picture."""
    state = begin(np.random.default_rng(9), 30, 9)
    sh0 = np.full_like(state.gaussians.sh0, 1e38)
    state = replace(state, scene=replace(state.scene, gaussians=replace(state.gaussians, sh0=sh0)))
    packet = encode_delta(Delta((Light((0.5, 2.0, 1.0)),)), state.layout, {}, frame=1)
    return Victim(state, packet, _lies())


def _lies() -> Lies:
    for size in (0, 1, 5, 7, 600):
        yield f"{size} bytes", "light", bytes(size), f"light: expected 6 bytes, got {size}"
    for wrong in (0.0, -0.0, -1.0, 0.0039, 257.0, 65504.0, float("nan"), float("inf"), -float("inf")):
        for channel in range(3):
            factor = [1.0, 1.0, 1.0]
            factor[channel] = wrong
            yield f"factor {wrong} of channel {channel}", "light", struct.pack("<3e", *factor), "expected three numbers"
    yield "beyond float32", "light", struct.pack("<3e", 1, 1, 4), "out of the range of float32"
