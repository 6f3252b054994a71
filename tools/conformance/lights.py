"""Vectors of lights: factors on the colours of a scene, sound and refused."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from gsstream.core.changes import Delta, Light, RowEdit, apply_light
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.packet.gates import encode_gates
from tools.conformance.edits import added
from tools.conformance.lying_files import begun
from tools.conformance.moving import motion, section, written
from tools.conformance.residuals import attribute, residual
from tools.conformance.tapes import Tape, Vector, playing, refusing

NAN, INFINITY = float("nan"), float("inf")
#: The next of binary16 above 256 and below 1/256.
ABOVE, BELOW = 256.25, 0.0039043426513671875


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _sound()
    yield from _faulty()


def light(*factor: float) -> bytes:
    """Return the section light."""
    return struct.pack("<3e", *factor)


def _sound() -> Iterator[Vector]:
    for degree, rest in enumerate((0, 3, 8, 15)):
        tape = Tape().start(500 + degree, 12, 5, rest)
        for factor in ((1.2998046875, 1.2998046875, 1.2998046875), (1, 0.5, 2), (256, 0.00390625, 0.7001953125)):
            tape.delta([("light", light(*factor))])
        yield playing(f"light-alone-degree-{degree}", "light harmonics", "4.10-1 4.10-2 4.2-2", tape.empty())
    tape = Tape().start(510, 14, 6, 3)
    for seed in range(2):  # groups are formed by the brightness that the light leaves
        lit = apply_light(tape.here.scene, Light((2.0, 1.5, 0.5)))
        moved = section(written(motion(lit, seed, cell=4.0, bins=16, regroup=seed > 0)))
        change = residual(tape, seed, ATTRIBUTES, latents=2)
        tape.delta([("light", light(2.0, 1.5, 0.5)), ("motion", moved), *change])
    yield playing("light-before-motions-and-a-residual", "light motion residual", "4.2-2 4.4-6 4.10-1", tape)
    tape = Tape().start(511, 8, 4, 3)
    edit = RowEdit(added(tape, 1, [0, 2], 1), np.array([1, 5]))
    tape.change(Delta((Light((0.5, 0.5, 0.5)), edit)))
    yield playing("light-and-rows", "light rows", "4.2-2 4.7-1", tape)
    tape = Tape().start(512, 0, 3, 3).delta([("light", light(2, 2, 2))])
    yield playing("light-of-an-empty-scene", "light empty-scene", "4.10-1", tape)
    # A product that is too small for float32 is 0 or -0, which the residual's 0 rids of its sign.
    tape = Tape().start(513, 6, 1, 3)
    for _ in range(30):
        tape.delta([("light", light(0.0625, 0.0625, 0.0625))])
    tape.delta([("gates", encode_gates(np.ones(1, np.uint8), 1)), ("shN", attribute(np.zeros((6, 9), int), 0.125, 0))])
    yield playing("light-until-nothing-is-left", "light residual", "4.10-1 0.4-1", tape)


def _faulty() -> Iterator[Vector]:
    for name, value in (
        ("0", 0.0), ("minus-1", -1.0), ("below", BELOW), ("above", ABOVE), ("nan", NAN), ("infinite", INFINITY),
    ):  # fmt: skip
        for channel in range(3):
            factor = [1.0, 1.0, 1.0]
            factor[channel] = value
            lie = begun().refused([("light", light(*factor))])
            yield refusing(f"light-{name}-channel-{channel}", "light", "4.10-1", lie)
    for size in (0, 5, 7):
        data = (light(1, 1, 1) + b"\0")[:size]
        yield refusing(f"light-of-{size}-bytes", "light", "1.3-6", begun().refused([("light", data)]))
    state = begun()
    moved = section(written(motion(state.here.scene, 1)))
    late = begun().refused([("motion", moved), ("light", light(1, 1, 1))])
    yield refusing("light-behind-a-motion", "light", "4.2-2", late)
    for name in ("sh0", "shN"):
        tape = _bright(name)
        yield refusing(f"light-{name}-beyond-float32", "light", "4.10-2", tape)


def _bright(name: str) -> Tape:
    """A stream whose colours grow as far as a few residuals and lights take them, and then further."""
    tape = Tape().start(520, 4, 1, 3)
    width = 3 if name == "sh0" else 9
    symbols = np.full((4, width), 1 << 30, np.int32)
    tape.delta([("gates", encode_gates(np.ones(1, np.uint8), 1)), (name, attribute(symbols, 900_000.0, 0))])
    while float(np.abs(getattr(tape.here.gaussians, name)).max()) < 2e37:
        tape.delta([("light", light(16, 16, 16))])
    return tape.refused([("light", light(16, 16, 16))])
