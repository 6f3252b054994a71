"""Delta packets whose sections, residual or decoders are refused, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from tools.conformance.coding import constant, run_gates
from tools.conformance.lying_files import OPEN, begun
from tools.conformance.lying_rows import joining
from tools.conformance.moving import motion, section, written
from tools.conformance.residuals import attribute, decoder
from tools.conformance.tapes import Tape, Vector, refusing

NAN, INFINITY = float("nan"), float("inf")


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _sections()
    yield from _residuals()
    yield from _decoders()


def _sections() -> Iterator[Vector]:
    some = ("opacities", attribute([[1]] * 6, 0.5))
    gates, pattern = ("gates", OPEN), ("pattern", constant(1, 6))
    moved = ("motion", section(written(motion(begun().here.scene, 1))))
    gone = ("removed", run_gates([1, 5], 1))
    joins = ("added", joining())
    orders: dict[str, tuple[list[tuple[str | int, bytes]], str]] = {
        "nothing": ([], "4.2-2"),
        "a-meta": ([gates, ("meta", b"")], "4.2-2"),
        "a-layout": ([("layout", b"")], "4.2-2"),
        "an-index": ([("index", b"")], "4.2-2"),
        "layers": ([gates, ("layers", b"")], "4.2-2"),
        "gates-before-motion": ([gates, moved], "4.2-2"),
        "attribute-before-pattern": ([gates, some, pattern], "4.2-2"),
        "pattern-before-gates": ([pattern, gates, some], "4.2-2"),
        "sh0-before-opacities": ([gates, ("sh0", attribute([[1] * 3] * 6, 0.5)), some], "4.2-2"),
        "removed-before-gates": ([gone, gates], "4.2-2"),
        "added-before-removed": ([joins, gone], "4.2-2"),
        "attribute-without-gates": ([some], "4.2-3"),
        "pattern-without-gates": ([pattern, some], "4.2-3"),
        "decoders-without-gates": ([("decoders", b"")], "4.2-3"),
        "pattern-without-attribute": ([gates, pattern], "4.2-4"),
    }
    for name, (sections, rule) in orders.items():
        yield refusing(f"delta-{name}", "residual", rule, begun().refused(sections))


def _residuals() -> Iterator[Vector]:
    ones = constant(1, 6)

    def said(mode: int, channels: int, step: float, table: bytes = ones, name: str = "opacities") -> Tape:
        return begun().refused([("gates", OPEN), (name, struct.pack("<BBf", mode, channels, step) + table)])

    for number in (-1, 2, 3):
        some = [("pattern", constant(number, 6)), ("opacities", attribute([[1]] * 6, 0.5))]
        yield refusing(f"pattern-of-{number}", "residual pattern", "4.6-4", begun().refused([("gates", OPEN), *some]))
    cases = {
        "mode-2": (said(2, 1, 0.5), "4.6-5"),
        "mode-1-without-decoder": (said(1, 1, 0.5), "4.6-5"),
        "no-channel": (said(0, 0, 0.5, b""), "4.6-6"),
        "two-channels": (said(0, 2, 0.5, constant(1, 6, 2)), "4.6-6"),
        "65-channels": (said(0, 65, 0.5, constant(1, 6, 65), "shN"), "4.6-6"),
        "other-harmonics": (said(0, 24, 0.5, constant(1, 6, 24), "shN"), "4.6-7"),
        "step-0": (said(0, 1, 0.0), "4.6-8"),
        "step-below-0": (said(0, 1, -0.5), "4.6-8"),
        "step-a-million": (said(0, 1, 1e6), "4.6-8"),
        "step-nan": (said(0, 1, NAN), "4.6-8"),
        "step-infinite": (said(0, 1, INFINITY), "4.6-8"),
        "cut": (begun().refused([("gates", OPEN), ("opacities", b"\0\1\0\0")]), "1.3-6"),
        "harmonics-of-a-scene-without": (
            begun(0).refused([("gates", OPEN), ("shN", attribute([[1] * 9] * 6, 0.5))]),
            "4.6-7",
        ),
    }
    for name, (tape, rules) in cases.items():
        yield refusing(f"residual-{name}", "residual", rules, tape)


def _decoders() -> Iterator[Vector]:
    used = ("sh0", attribute([[1, 2]] * 6, 0.5, 1))
    weights = np.ones((2, 3))

    def said(data: bytes, *attributes: tuple[str, bytes]) -> Tape:
        return begun().refused([("gates", OPEN), ("decoders", data), *attributes])

    sound = decoder("sh0", weights)
    cases = {
        "attribute-6": (said(b"\6" + sound[1:], used), "4.6-1"),
        "twice": (said(sound * 2, used), "4.6-1"),
        "no-latent": (said(b"\4\0\3", used), "4.6-1"),
        "65-latents": (said(decoder("sh0", np.ones((65, 3))), used), "4.6-1 1.8-1"),
        "other-width": (said(decoder("sh0", np.ones((2, 4))), used), "4.6-1"),
        "no-width": (said(b"\5\2\0", used), "4.6-1"),
        "cut": (said(sound[:-1], used), "4.6-1 1.3-6"),
        "head-cut": (said(sound + b"\5\1", used), "4.6-1 1.3-6"),
        "infinite": (said(decoder("sh0", weights * INFINITY), used), "4.6-2"),
        "nan": (said(decoder("sh0", weights * NAN), used), "4.6-2"),
        "of-no-attribute": (said(sound), "4.6-3"),
        "of-a-direct-attribute": (said(sound, ("sh0", attribute([[1] * 3] * 6, 0.5))), "4.6-3"),
        "of-other-latents": (said(decoder("sh0", np.ones((3, 3))), used), "4.6-6"),
        "of-other-harmonics": (
            said(decoder("shN", np.ones((2, 24))), ("shN", attribute([[1, 2]] * 6, 0.5, 1))),
            "4.6-7",
        ),
    }
    for name, (tape, rules) in cases.items():
        yield refusing(f"decoder-{name}", "residual decoder", rules, tape)
    tape = begun().delta([("gates", OPEN), ("decoders", sound), used]).start(470, 6, 4, 3)
    yield refusing(
        "decoder-forgotten-by-a-key-packet", "residual decoder", "4.6-5", tape.refused([("gates", OPEN), used])
    )
    largest = attribute([[(1 << 31) - 1, -(1 << 31)]] * 6, 9e5, 1)
    tape = said(decoder("sh0", np.full((2, 3), 65504.0)), ("sh0", largest))
    yield refusing("residual-too-large", "residual decoder extremes", "4.6-9", tape)
