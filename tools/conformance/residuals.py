"""Vectors of residuals: modes, levels, patterns and harmonics crossed; decoders; extremes; tables of every form."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gsstream.core.changes import sent_rows
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import IntArray
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols
from tools.conformance.coding import Model, bits, column, constant, parts, run_gates, table
from tools.conformance.tapes import Tape, Vector, key_sections, layout, playing, scene

#: Counts that fall from 32 bits to 1, by half each time.
FALLING = [5 << n >> 2 for n in range(31, 1, -1)]
Listed = list[tuple[str | int, bytes]]


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _cross()
    yield from _gates()
    yield from _decoders()
    yield from _extremes()
    yield from _tables()


def attribute(symbols: Any, step: float, mode: int = 0, channels: int | None = None) -> bytes:
    """Return the section of an attribute: symbols [K, L]."""
    array = np.asarray(symbols, np.int32)
    width = array.shape[1] if channels is None else channels
    return struct.pack("<BBf", mode, width, step) + encode_symbols(array)


def decoder(name: str, values: Any) -> bytes:
    """Return what the section decoders says of one attribute."""
    array = np.asarray(values, np.float16)
    return struct.pack("<BBB", ATTRIBUTES.index(name), *array.shape) + array.astype("<f2").tobytes()


def width_of(tape: Tape, name: str) -> int:
    """Return how many values of an attribute a row has."""
    return int(np.prod(getattr(tape.here.gaussians, name).shape[1:]))


def residual(
    tape: Tape,
    seed: int,
    names: Sequence[str],
    *,
    levels: int = 1,
    latents: int = 0,
    pattern: str | None = "needed",
    share: float = 0.6,
    gates: IntArray | None = None,
) -> Listed:
    """Return the sections of a random residual; ``latents``: channels behind a decoder, 0: directly.

    ``pattern``: bits where symbols need them, all bits, bits at random, or None: no pattern.
    """
    rng = np.random.default_rng(seed)
    counts = tape.here.layout.node_counts
    if gates is None:
        gates = ((rng.random(len(counts)) < share) * rng.integers(1, levels + 1, len(counts))).astype(np.uint8)
    rows = len(sent_rows(tape.here.layout, gates))
    found: Listed = [("gates", encode_gates(gates, levels))]
    symbols = {n: rng.integers(-3, 4, (rows, latents or width_of(tape, n))) for n in names}
    for array in symbols.values():
        array[rng.random(rows) < 0.3] = 0
    said = np.zeros(rows, np.int32)
    for bit, array in enumerate(symbols.values()):
        some = {"needed": array.any(1), "all": np.ones(rows, bool), "random": rng.random(rows) < 0.5}
        said |= some[pattern or "all"].astype(np.int32) << bit
    if pattern:
        found.append(("pattern", encode_symbols(said[:, None])))
    if latents:
        known = {n: rng.normal(size=(latents, width_of(tape, n))) for n in names}
        found.append(("decoders", b"".join(decoder(n, values) for n, values in known.items())))
    for bit, (name, array) in enumerate(symbols.items()):
        kept = array[(said >> bit & 1) != 0]
        found.append((name, attribute(kept, float(rng.choice([0.01, 0.125, 0.3])), int(latents > 0))))
    return found


def _cross() -> Iterator[Vector]:
    names = {0: ATTRIBUTES[:5], 3: ATTRIBUTES}
    cases = itertools.product((1, 3, 255), (0, 2), (None, "needed"), (0, 3))
    for number, (levels, latents, pattern, degree) in enumerate(cases):
        tape = Tape().start(100 + number, 14, 8, {0: 0, 3: 15}[degree])
        for frame in range(2):
            tape.delta(
                residual(tape, 9 * number + frame, names[degree], levels=levels, latents=latents, pattern=pattern)
            )
        mode = "decoder" if latents else "direct"
        name = f"residual-{mode}-{levels}-levels-{'pattern' if pattern else 'plain'}-degree-{degree}"
        features = f"residual {mode} levels-{levels} {'pattern ' if pattern else ''}harmonics"
        yield playing(name, features, "4.2-1 4.2-2 4.6-4 4.6-5 4.6-6 4.6-7 0.4-1", tape)
    for name in ATTRIBUTES:
        tape = Tape().start(130, 10, 6, 8)
        tape.delta(residual(tape, 1, [name])).delta(residual(tape, 2, [name], latents=3, levels=7, pattern=None))
        yield playing(f"residual-only-{name}", "residual", "4.2-2 4.6-1 4.6-6", tape)
    tape = Tape().start(131, 10, 6, 8)
    for pattern in ("all", "random"):
        tape.delta(residual(tape, 5, ATTRIBUTES, pattern=pattern, levels=4))
    yield playing("residual-pattern-bits-beyond-need", "residual pattern", "4.6-4", tape)


def _gates() -> Iterator[Vector]:
    tape = Tape().start(140, 10, 6, 3)
    tape.delta([("gates", encode_gates(np.ones(6, np.uint8), 1))])
    tape.delta(residual(tape, 1, ["means", "sh0"], gates=np.zeros(6, np.uint8)))
    tape.delta(residual(tape, 2, ["means", "sh0"], gates=np.full(6, 9, np.uint8), levels=9))
    yield playing("gates-alone-closed-open", "residual gates", "2.8-1 4.2-2", tape)
    tape = Tape().start(141, 0, 70000 // 2, 0)
    rng = np.random.default_rng(142)
    runs = [*range(1, 40), *(1 << rng.integers(4, 13, 24)).tolist(), *(1 + rng.integers(1, 900, 30)).tolist()]
    runs.append(35000 - sum(runs))
    assert runs[-1] > 0, "the runs fit the nodes"
    tape.delta([("gates", run_gates(runs, 0))]).delta([("gates", run_gates(runs, 1))])
    open_nodes = sum(runs[1::2])
    tape.delta([("gates", run_gates(runs, 0, 3, [1 + i % 3 for i in range(open_nodes)]))])
    yield playing("gates-runs-of-every-length", "gates", "2.8-2 2.8-3 2.8-4 2.8-5 2.8-6", tape)
    tape = Tape().start(143, 0, 0, 3, units=())
    tape.delta([("gates", parts(b"\xe0", b"", b"", b""))]).delta([("gates", parts(b"\xc0", b"", b"", b""))])
    yield playing("gates-of-no-nodes", "gates empty-scene", "2.8-2", tape)
    # Nodes that are open and hold nothing, and attributes that have no row to change.
    sections = key_sections(scene(144, 3, 3), layout(144, 3, 1))
    sections["layout"] = struct.pack("<IIBf", 3, 4, 1, 1.0) + parts(column([0, 3, 0, 0]), constant(0, 3))
    tape = Tape().key(sections)
    tape.delta(
        [
            ("gates", run_gates([1, 1, 2], 1)),
            ("means", attribute(np.zeros((0, 3)), 0.1)),
            ("shN", attribute(np.zeros((0, 24)), 0.1)),
        ]
    )
    tape.delta([("gates", run_gates([1, 2, 1], 0)), ("means", attribute([[1, 2, 3], [0, 0, 0], [-1, 0, 5]], 0.1))])
    yield playing("gates-open-empty-nodes", "residual gates", "4.6-7", tape)
    tape.delta([("gates", run_gates([4], 0, 255)), ("pattern", b""), ("opacities", attribute(np.zeros((0, 1)), 0.1))])
    yield playing("gates-nothing-open", "residual gates pattern", "2.8-5 4.2-4", tape)


def _decoders() -> Iterator[Vector]:
    tape = Tape().start(150, 10, 5, 3)
    tape.delta(residual(tape, 1, ["sh0", "shN"], latents=2))
    everything = encode_gates(np.ones(5, np.uint8), 1)
    rng = np.random.default_rng(151)

    def latent(name: str, channels: int, *more: tuple[str, bytes]) -> Listed:
        return [("gates", everything), *more, (name, attribute(rng.integers(-9, 9, (10, channels)), 0.02, 1))]

    tape.delta(latent("sh0", 2)).empty().delta(latent("shN", 2))
    tape.delta(latent("sh0", 4, ("decoders", decoder("sh0", rng.normal(size=(4, 3)))))).delta(latent("sh0", 4))
    tape.delta([("gates", everything), ("sh0", attribute(rng.integers(-9, 9, (10, 3)), 0.02))]).delta(latent("sh0", 4))
    yield playing("decoders-held-and-replaced", "residual decoder", "4.6-1 4.6-3 4.6-5", tape)
    small = np.array([1, 2, 1023, 1024, 0x8001, 0x8400, 0x7BFF, 0xFBFF, 0x8000, 0, 0x3C00, 0xBC00], np.uint16).view(
        np.float16
    )
    tape = Tape().start(152, 10, 5, 3)
    tape.delta(latent("sh0", 4, ("decoders", decoder("sh0", small.reshape(4, 3)))))
    yield playing("decoders-every-kind-of-half", "residual decoder", "4.6-2 0.4-1", tape)
    tape = Tape().start(153, 10, 5, 3)
    tape.delta(latent("quats", 64, ("decoders", decoder("quats", rng.normal(size=(64, 4))))))
    tape.delta([("gates", everything), ("decoders", b""), ("sh0", attribute(np.ones((10, 3)), 0.5))])
    yield playing("decoders-64-latents-and-none", "residual decoder", "4.6-1 4.6-6", tape)


def _extremes() -> Iterator[Vector]:
    everything = encode_gates(np.ones(2, np.uint8), 1)
    big, least = 2**31 - 1, -(2**31)

    def extreme(seed: int, unit: float, symbols: Any, step: float) -> Tape:
        tape = Tape().start(seed, 4, 2, 0, units=(unit,), spread=1e-3)
        return tape.delta([("gates", everything), ("means", attribute(symbols, step))])

    rows = [[big, least, 1], [0, -1, 7], [3, 0, 0], [1, 1, -1]]
    yield playing("residual-largest-symbols", "residual extremes", "4.6-9 2.7-1", extreme(160, 1.0, rows, 9e5))
    yield playing(
        "residual-largest-step", "residual extremes", "4.6-8", extreme(161, 9e8, np.clip(rows, -9, 9), 999999.9)
    )
    yield playing(
        "residual-subnormal", "residual extremes", "0.4-1 4.6-8", extreme(162, 1e-20, np.clip(rows, -9, 9), 1e-20)
    )
    yield playing("residual-smallest-step", "residual extremes", "0.4-1 4.6-8", extreme(163, 1e-38, rows, 1e-45))
    tape = Tape().start(164, 4, 2, 0)
    odd = [[16777217, 33554435, -16777219]] * 4
    for levels in (3, 7, 255):
        gates = encode_gates(np.array([1, 2], np.uint8), levels)
        tape.delta([("gates", gates), ("means", attribute(odd, 1e-9)), ("scales", attribute(odd, 1e-9))])
    yield playing("residual-every-rounding", "residual extremes levels-255", "0.4-1", tape)


def _tables() -> Iterator[Vector]:
    everything = run_gates([1], 1)

    def coded(seed: int, columns: Sequence[Sequence[int]], models: Sequence[Model], shared: bool = False) -> Tape:
        name, step = {1: ("opacities", 1e-9), 3: ("means", 1e-9)}[len(columns)]
        tape = Tape().start(seed, len(columns[0]), 1, 0)
        data = struct.pack("<BBf", 0, len(columns), step) + table(columns, models, shared)
        return tape.delta([("gates", everything), (name, data)])

    big, least = 2**31 - 1, -(2**31)
    rng = np.random.default_rng(170)
    some = rng.integers(0, 5, 30).tolist()
    three = [some, some[::-1], [2] * 30]
    counts = Model(0, [5, 6, 7, 6, 6])
    cases: list[tuple[str, str, Any, list[Model], bool]] = [
        ("one-channel-shared", "2.3-1", [some], [counts], True),
        ("three-channels-shared", "2.3-1", three, [counts], True),
        ("three-models", "2.4-1 2.4-2", three, [counts, Model(-3, [1] * 9), Model(2, [1])], False),
        ("all-escaped", "2.7-1 2.7-2", [[big, least, 0, -1, 5, 12345]], [Model(3, [0, 9], True)], False),
        ("bin-and-escape-without-count", "2.4-4", [[0, 1, 2, 9, 0, -9]], [Model(0, [7, 0, 0, 0], True)], False),
        ("lowest-bins", "2.4-2 2.7-1", [[least, least + 1, big, 0, least]], [Model(least, [2, 1, 1], True)], False),
        ("highest-bins", "2.4-2 2.7-1", [[big, big - 1, least, 0, big]], [Model(big - 1, [2, 1, 1], True)], False),
        ("most-bins", "2.4-1", [[0, 16383, 8000, 16383]], [Model(0, [1] + [0] * 7999 + [3] + [0] * 8382 + [1])], False),
        ("counts-of-every-length", "2.4-3", [list(range(33))], [Model(0, [(1 << n) - 1 for n in range(33)])], False),
        ("counts-falling", "2.4-3 2.5-1", [[i % 33 for i in range(60)]], [Model(0, [*FALLING, 1, 0, 1])], False),
        ("no-words", "2.6-3", [[4] * 9], [Model(4, [9, 1, 1])], False),
        ("rarest-symbols", "2.5-1 2.6-3", [[1] * 12], [Model(0, [1 << 31, 0, 1 << 31])], False),
    ]
    for number, (name, rules, columns, models, shared) in enumerate(cases):
        yield playing(f"coder-{name}", "coder", rules, coded(171 + number, columns, models, shared))
    long = rng.integers(0, 40, 900).tolist()
    yield playing(
        "coder-many-words",
        "coder",
        "2.6-1 2.6-2 2.6-3",
        coded(190, [long], [Model(0, rng.integers(1, 90, 40).tolist())]),
    )
    tape = Tape().start(191, 6, 1, 0)
    data = table([[1, 2, 1, 1, 2, 1]], [Model(1, [4, 2])])
    head, words = data[1 : 1 + data[0]], data[1 + data[0] :]
    long_form = struct.pack("<BBf", 0, 1, 0.5) + parts(head, words, length=5)
    tape.delta(
        [
            ("gates", parts(bits(("gamma", 0), ("gamma", 1), ("bits", 1, 1)), b"", b"", b"", length=3)),
            ("opacities", long_form),
        ]
    )
    yield playing("coder-lengths-longer-than-needed", "coder", "2.2-1", tape)
