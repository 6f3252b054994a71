"""Key packets that are refused, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import numpy as np

from gsstream.packet.symbols import encode_symbols
from tools.conformance.coding import bits, column, constant, parts
from tools.conformance.keys import coded, flat
from tools.conformance.tapes import (
    KEY,
    Sections,
    Tape,
    Vector,
    key_sections,
    layered,
    layout,
    packet,
    refusing,
    scene,
)


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _sections()
    yield from _layouts()
    yield from _attributes()
    yield from _positions()
    yield from _layers()


def base(rest: int = 3) -> Sections:
    """Return sound sections of six rows in three nodes, one unit of three unused."""
    return key_sections(scene(450, 6, rest), layout(450, 6, 3))


def lie(sections: Sections) -> bytes:
    """Return a stream of a sound frame and a key packet of these sections."""
    tape = Tape().start(451, 2, 1, 0)
    return tape.lie(packet(KEY, 1, list(sections.items()))).bytes()


def _sections() -> Iterator[Vector]:
    for name in ("meta", "layout", "means", "shN"):
        yield refusing(f"key-without-{name}", "key", "3.1-1", lie({n: d for n, d in base().items() if n != name}))
    for name in ("gates", "index", "layers", "rest"):
        yield refusing(f"key-with-{name}", "key", "3.1-1", lie({**base(), name: b""}))
    first = key_sections(scene(452, 6, 3), layout(452, 6, 3), first=np.arange(6) % 2 == 0)
    turned = {name: first[name] for name in [*list(first)[:-2], "rest", "layout"]}
    yield refusing("layers-in-another-order", "layers key", "3.1-1", lie(turned))
    late = {name: first[name] for name in [*list(first)[1:], "layers"]}
    yield refusing("layers-not-first", "layers key", "3.1-1", lie(late))
    yield refusing("layers-without-rest", "layers key", "3.1-1", lie({n: d for n, d in first.items() if n != "rest"}))


def laid(number: int, nodes: int, units: tuple[float, ...], *tables: bytes) -> bytes:
    """Return the section layout."""
    return struct.pack("<IIB", number, nodes, len(units)) + struct.pack(f"<{len(units)}f", *units) + parts(*tables)


def _layouts() -> Iterator[Vector]:
    counts, units = column([1, 2, 3]), constant(0, 6)
    many = 0xFFFFFFFF
    layouts = {
        "layout-cut": (b"\6\0\0\0\3\0\0\0", "1.3-6"),
        "layout-units-cut": (struct.pack("<IIBf", 6, 3, 2, 1.0), "1.3-6"),
        "layout-rows-beyond-the-packet": (laid(200_000, 3, (1.0,), counts, units), "3.5-1 1.8-1"),
        "layout-most-rows": (laid(many, 3, (1.0,), counts, units), "3.5-1 1.8-1"),
        "layout-nodes-beyond-the-packet": (laid(6, 200_000, (1.0,), counts, units), "3.5-1 1.8-1"),
        "layout-most-nodes": (laid(6, many, (1.0,), counts, units), "3.5-1 1.8-1"),
        "layout-65-units": (laid(6, 3, (1.0,) * 65, counts, units), "3.5-2"),
        "layout-unit-0": (laid(6, 3, (1.0, 0.0), counts, units), "3.5-3"),
        "layout-unit-below-0": (laid(6, 3, (-1.0,), counts, units), "3.5-3"),
        "layout-unit-nan": (laid(6, 3, (float("nan"),), counts, units), "3.5-3"),
        "layout-unit-infinite": (laid(6, 3, (float("inf"),), counts, units), "3.5-3"),
        "layout-unit-too-large": (laid(6, 3, (1e9,), counts, units), "3.5-3"),
        "layout-sum-too-small": (laid(6, 3, (1.0,), column([1, 2, 2]), units), "3.5-4"),
        "layout-sum-too-large": (laid(6, 3, (1.0,), column([1, 2, 4]), units), "3.5-4"),
        "layout-count-below-0": (laid(6, 3, (1.0,), column([5, -1, 2]), units), "3.5-4"),
        "layout-rows-in-no-node": (laid(6, 0, (1.0,), b"", units), "3.5-4"),
        "layout-unit-beyond-the-last": (laid(6, 3, (1.0,), counts, constant(1, 6)), "3.5-5"),
        "layout-unit-number-below-0": (laid(6, 3, (1.0,), counts, constant(-1, 6)), "3.5-5"),
        "layout-no-units": (laid(6, 3, (), counts, units), "3.5-5"),
    }
    for name, (data, rules) in layouts.items():
        yield refusing(name, "layout", rules, lie({**base(), "layout": data}))


def _attributes() -> Iterator[Vector]:
    for name, width in (("quats", 4), ("scales", 3), ("opacities", 1), ("sh0", 3), ("shN", 9)):
        columns = 5 if name == "quats" else width
        table = constant(0, 6, columns) if name != "quats" else encode_symbols(np.zeros((6, 5), np.int32))
        for fraction in (0, 21, -1) if name == "scales" else (0,):
            data = struct.pack("<bB", fraction, width) + table
            yield refusing(f"attribute-{name}-{fraction}-bits", "grids", "3.6-1", lie({**base(), name: data}))
        wrong = {"quats": 5, "shN": 12}.get(name, width + 1)
        data = struct.pack("<bB", 4, wrong) + constant(0, 6, wrong)
        yield refusing(f"attribute-{name}-{wrong}-channels", "grids", "3.6-2", lie({**base(), name: data}))
        yield refusing(f"attribute-{name}-cut", "grids", "1.3-6", lie({**base(), name: b"\4"}))
        if name == "quats":
            continue
        for code in (1 << 20, -(1 << 20)) if name == "opacities" else (1 << 20,):
            data = struct.pack("<bB", 4, width) + constant(code, 6, width)
            yield refusing(f"attribute-{name}-code-{code}", "grids", "3.6-3", lie({**base(), name: data}))
    quats = {
        "largest-of-4": ([4, 0, 0, 0, 0], "3.6-4"),
        "largest-of-minus-1": ([-1, 0, 0, 0, 0], "3.6-4"),
        "not-the-largest": ([0, 0, 100, 0, 19], "3.6-5"),
        "largest-is-0": ([0, 0, 0, 0, -128], "3.6-5"),
        "smaller-than-another": ([0, -300, 0, 0, 299], "3.6-5"),
        "code-too-large": ([0, 1 << 20, 0, 0, 1 << 20], "3.6-3"),
        "largest-too-large": ([0, 0, 0, 0, (1 << 20) - 128], "3.6-3"),
    }
    for name, (row, rule) in quats.items():
        # Of the first two: the root of 128^2 - 100^2 is 79.9, and 80 + 19 is below 100.
        rows = np.zeros((6, 5), np.int32)
        rows[2] = row
        yield refusing(f"quats-{name}", "grids", rule, lie({**base(), **coded("quats", rows, 4, 7)}))
    no_rows = {**base(0), "layout": laid(0, 0, (), b"", b""), **{k: v[:2] for k, v in flat(1).items()}, "means": b""}
    yield refusing(
        "attribute-symbols-of-no-rows", "grids empty-scene", "2.3-1 1.3-6", lie({**no_rows, "sh0": b"\4\3\0"})
    )
    yield refusing("means-bytes-of-no-rows", "positions empty-scene", "1.3-6", lie({**no_rows, "means": b"\0\0\0"}))


def _positions() -> Iterator[Vector]:
    still = constant(0, 6, 3)

    def placed(floor: int, cell: int, moves: bytes = still, fields: bytes = b"", scale: int = 16) -> bytes:
        scales = struct.pack("<bB", 4, 3) + constant(scale, 6, 3)
        return lie({**base(), "scales": scales, "means": struct.pack("<bbb", floor, 2, cell) + parts(moves, fields)})

    heads = {
        "floor-61": (61, 61),
        "floor-minus-61": (-61, -60),
        "cell-61": (60, 61),
        "cell-below-floor": (3, 2),
        "25-deep": (-20, 5),
    }
    for name, (floor, cell) in heads.items():
        yield refusing(f"means-{name}", "positions", "3.7-1", placed(floor, cell))
    yield refusing("means-cut", "positions", "1.3-6", lie({**base(), "means": b"\0\2"}))
    for name, axis in (("above", (1 << 29) + 1), ("below", -(1 << 29) - 1)):
        moves = np.zeros((6, 3), np.int32)
        moves[1, 2] = axis
        yield refusing(f"means-cell-{name}", "positions", "3.7-2", placed(0, 0, encode_symbols(moves)))
    moves = np.full((6, 3), 1 << 28, np.int32)
    yield refusing("means-cells-sum-up", "positions", "3.7-2", placed(0, 0, encode_symbols(moves)))

    def fine(fields: bytes) -> bytes:
        return placed(-9, 4, fields=fields, scale=-160)

    short, exact = bits(*[("bits", 1, 13)] * 17), bits(*[("bits", 1, 13)] * 18)
    yield refusing("means-bits-missing", "positions", "3.7-3", fine(short))
    yield refusing("means-bits-too-many", "positions", "3.7-3", fine(exact + b"\0"))
    yield refusing("means-bits-padding", "positions", "3.7-3", fine(exact[:-1] + bytes([exact[-1] | 1])))
    yield refusing("means-bits-of-no-depth", "positions", "3.7-3", placed(0, 0, fields=b"\0"))


def _layers() -> Iterator[Vector]:
    good = key_sections(scene(460, 6, 3), layout(460, 6, 3), first=np.arange(6) < 2)
    K, L, checksum = struct.unpack("<III", good["layers"])
    marks = np.array([[1], [1], [0], [0], [0], [0]], np.int32)
    old = encode_symbols(marks)

    def rest(table: bytes) -> Sections:
        start = parts(old, b"")
        assert good["rest"].startswith(start), "marks come first"
        return {**good, "rest": parts(table, good["rest"][len(start) :])}

    def heads(*said: int) -> Sections:
        return {**good, "layers": struct.pack("<III", *said)}

    wider = key_sections(scene(461, 6, 8), layout(460, 6, 3), first=np.arange(6) < 2)
    cases: list[tuple[str, str, Sections, Callable[[Sections], Sections]]] = [
        ("11-bytes", "3.8-1", {**good, "layers": good["layers"][:11]}, dict),
        ("13-bytes", "3.8-1", {**good, "layers": good["layers"] + b"\0"}, dict),
        ("more-rows-than-the-scene", "3.8-2", heads(7, L, checksum), dict),
        ("one-byte-less", "3.8-3", heads(K, L - 1, checksum), dict),
        ("all-bytes", "3.8-3", heads(K, 0xFFFFFFFF, checksum), dict),
        ("checksum-damaged", "3.8-4", heads(K, L, checksum ^ 1), dict),
        ("mark-2", "3.8-5", rest(encode_symbols(marks * 2)), dict),
        ("mark-below-0", "3.8-5", rest(encode_symbols(np.array([[1], [1], [1], [-1], [0], [0]], np.int32))), dict),
        ("marks-too-many", "3.8-5", rest(constant(1, 6)), dict),
        ("marks-too-few", "3.8-5", rest(constant(0, 6)), dict),
        ("other-harmonics", "3.8-6", {**good, "rest": wider["rest"]}, layered),
    ]
    for name, rule, sections, mend in cases:
        yield refusing(f"layers-{name}", "layers", rule, lie(mend(sections)))
