"""Vectors of key packets: harmonics, layers, grids, layouts, empty scenes, meta."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gsstream.core.changes import Layout
from gsstream.core.world import World
from gsstream.packet.bits import compress
from gsstream.packet.symbols import encode_symbols
from tools.conformance.coding import bits, constant, parts
from tools.conformance.tapes import (
    Sections,
    Tape,
    Vector,
    key_sections,
    layered,
    layout,
    meta_json,
    plain_frame,
    playing,
    scene,
)

DEGREES = {0: 0, 1: 3, 2: 8, 3: 15}


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _harmonics()
    yield from _no_rows()
    yield from _layouts()
    yield from _grids()
    yield from _positions()
    yield from _layers()
    yield from _places()
    yield from _metas()


def _harmonics() -> Iterator[Vector]:
    for degree, rest in DEGREES.items():
        yield playing(f"key-degree-{degree}", "harmonics key", "3.1-1 3.6-2 0.5-1", Tape().start(degree, 9, 5, rest))
        first = np.arange(9) % 3 == 0
        tape = Tape().start(degree, 9, 5, rest, first=first)
        yield playing(f"layers-degree-{degree}", "layers harmonics", "3.1-1 3.8-4 3.8-5 3.8-6", tape)
    yield playing("key-large", "key coder", "2.5-1 2.6-3 3.7-2", Tape().start(9, 1500, 300, 0))


def _no_rows() -> Iterator[Vector]:
    for degree, rest in DEGREES.items():
        tape = Tape().start(20, 0, 0, rest, units=()).empty()
        yield playing(f"empty-scene-degree-{degree}", "empty-scene harmonics", "2.3-1 3.5-4 3.6-2", tape)
    yield playing("empty-scene-with-nodes", "empty-scene layout", "3.5-4", Tape().start(21, 0, 5, 3))
    first = np.zeros(0, np.bool_)
    yield playing("empty-scene-layers", "empty-scene layers", "3.8-2 3.8-5", Tape().start(22, 0, 2, 3, first=first))


def _layouts() -> Iterator[Vector]:
    yield playing("layout-one-row", "layout", "3.5-4", Tape().start(30, 1, 1, 0, units=(2.0,)))
    yield playing("layout-one-node", "layout", "3.5-4", Tape().start(31, 12, 1, 0))
    yield playing("layout-empty-nodes", "layout", "3.5-4", Tape().start(32, 5, 40, 0))
    units = [2.0**-k for k in range(-20, 44)]
    yield playing("layout-64-units", "layout", "3.5-2 3.5-5", Tape().start(33, 100, 10, 0, units=units))
    tiny = [float(np.float32(1e-45)), float(np.float32(1e-38)), float(np.nextafter(np.float32(1e9), np.float32(0)))]
    yield playing("layout-unit-limits", "layout", "3.5-3", Tape().start(34, 20, 4, 0, units=tiny))
    stored = Layout(np.ones(8, np.int32), np.zeros(8, np.uint8), np.ones(1, np.float32))
    yield playing("layout-a-node-each", "layout", "3.5-4", Tape().key(key_sections(scene(35, 8), stored)))
    sections = key_sections(scene(36, 0), layout(36, 0, 0, ()))
    many = struct.pack("<IIB", 65536, 65536, 1) + struct.pack("<f", 1) + parts(constant(1, 65536), constant(0, 65536))
    sections |= {"layout": many, **flat(65536)}
    # 65,536 rows are free; each further row needs a 64th of a byte.
    yield playing("layout-most-rows-of-a-small-packet", "layout limits", "3.5-1 1.8-1", Tape().key(sections))


def flat(number: int) -> Sections:
    """Return attribute sections of equal rows."""
    return {
        "means": struct.pack("<bbb", 0, 0, 0) + parts(constant(0, number, 3), b""),
        "quats": struct.pack("<bB", 7, 4) + _columns([[0] * number] * 4 + [[0] * number]),
        "scales": struct.pack("<bB", 4, 3) + constant(-32, number, 3),
        "opacities": struct.pack("<bB", 3, 1) + constant(8, number),
        "sh0": struct.pack("<bB", 6, 3) + constant(1, number, 3),
        "shN": struct.pack("<bB", 7, 0),
    }


def _columns(columns: list[list[int]]) -> bytes:
    return encode_symbols(np.array(columns, np.int32).T)


def coded(name: str, table: Any, width: int, fraction: int) -> Sections:
    """Return one attribute section of symbols [N, ...] on the grid 2^-fraction."""
    return {name: struct.pack("<bB", fraction, width) + encode_symbols(np.asarray(table, np.int32))}


def _grids() -> Iterator[Vector]:
    rng = np.random.default_rng(40)
    base = key_sections(scene(40, 16, 3), layout(40, 16, 4))
    widths = {"scales": 3, "opacities": 1, "sh0": 3, "shN": 9}
    for fraction in (1, 20):
        most = (1 << 20) - 1
        for name, width in widths.items():
            table = rng.integers(-most, most + 1, (16, width))
            table[0], table[1] = most, -most
            sections = {**base, **coded(name, table, width, fraction)}
            if name == "scales":
                sections |= {
                    "means": struct.pack("<bbb", 3, 0, 3)
                    + parts(encode_symbols(rng.integers(-9, 9, (16, 3)).astype(np.int32)), b"")
                }
                sections["scales"] = struct.pack("<bB", fraction, 3) + encode_symbols(
                    np.abs(table).clip(0, 3).astype(np.int32) * -1
                )
            yield playing(f"grid-{name}-{fraction}-bits", "grids key", "3.6-1 3.6-3", Tape().key(sections))
        quats: list[list[int]] = []
        for row in range(16):
            one = 1 << fraction
            others = rng.integers(-one // 2, one // 2 + 1, 3).tolist()
            quats.append([row % 4, *others, int(rng.integers(0, 3)) + (one if fraction == 1 else 0)])
        yield playing(
            f"grid-quats-{fraction}-bits",
            "grids key",
            "3.6-1 3.6-4 3.6-5",
            Tape().key({**base, **coded("quats", quats, 4, fraction)}),
        )
    quats = [
        [j, a, b, c, r]
        for j in range(4)
        for a, b, c, r in ((0, 0, 0, 0), (100, -100, 100, 900), (1000, 1000, -1000, 0), (0, 0, 1, -127))
    ]
    quats[3][4] = -126
    yield playing(
        "quats-unusual-norms",
        "grids key",
        "3.6-3 3.6-4 3.6-5",
        Tape().key({**base, **coded("quats", _sound(quats), 4, 7)}),
    )


def _sound(table: list[list[int]]) -> list[list[int]]:
    """Raise r where the largest component would not be the largest."""
    for row in table:
        rest = max(0, 4**7 - sum(value * value for value in row[1:4]))
        least = max(1, *(abs(value) for value in row[1:4])) - round(rest**0.5)
        row[4] = max(row[4], least)
    return table


def _positions() -> Iterator[Vector]:
    base = key_sections(scene(50, 6), layout(50, 6, 2))

    def placed(floor: int, fine: int, cell: int, moves: Any, scales: Any, fields: Any = ()) -> Tape:
        means = struct.pack("<bbb", floor, fine, cell)
        means += parts(encode_symbols(np.asarray(moves, np.int32)), bits(*fields) if fields else b"")
        return Tape().key({**base, **coded("scales", scales, 3, 4), "means": means})

    rng = np.random.default_rng(51)
    still, steps = np.full((6, 3), 16), rng.integers(-40, 40, (6, 3))
    yield playing("means-no-bits", "positions", "3.7-1 3.7-3", placed(0, 0, 0, steps, still))
    yield playing("means-least-exponents", "positions", "3.7-1", placed(-60, 0, -60, steps, still))
    yield playing("means-largest-exponents", "positions", "3.7-1", placed(60, 0, 60, steps, still))
    small = np.full((6, 3), -(1 << 19))
    deep = [("bits", int(v), 24) for v in rng.integers(0, 1 << 24, 18)]
    yield playing("means-24-bits", "positions", "3.7-1 3.7-3", placed(-20, 0, 4, steps, small, deep))
    far = np.zeros((6, 3), int)
    far[0], far[1], far[2] = 1 << 29, -(1 << 30), 1 << 30
    yield playing("means-farthest-cells", "positions", "3.7-2", placed(-30, 0, -6, far, small, deep))
    for fine in (-128, 127):
        fields = deep if fine == 127 else ()
        yield playing(f"means-fineness-{fine}", "positions", "3.7-1", placed(-20, fine, 4, steps, still, fields))
    mixed = np.array([[-160, 0, 0], [-9, -9, -9], [0, -1, 5], [-33, -32, -31], [16, 17, 18], [-90, -60, 3]])
    depths = [max(0, 4 - max(-9, (int(row.min()) * 1512775 >> 24) - 2)) for row in mixed]
    fields = [("bits", int(rng.integers(0, 1 << d)), d) for d in depths for _ in range(3)]
    yield playing("means-mixed-depths", "positions", "3.7-3", placed(-9, 2, 4, steps, mixed, fields))


def _layers() -> Iterator[Vector]:
    for name, first in (("none", np.zeros(7, np.bool_)), ("all", np.ones(7, np.bool_)), ("one", np.arange(7) == 4)):
        tape = Tape().start(60, 7, 3, 3, first=first).empty()
        yield playing(f"layers-first-has-{name}", "layers", "3.8-1 3.8-2 3.8-3 3.8-5", tape)
    tape = Tape().start(61, 200, 40, 15, first=np.arange(200) % 5 == 1)
    yield playing("layers-many", "layers harmonics", "3.8-3 3.8-4", tape)


def _places() -> Iterator[Vector]:
    sections = key_sections(scene(70, 5, 3), layout(70, 5, 3))
    turned = dict(reversed(sections.items()))
    yield playing("key-sections-reversed", "key container", "3.1-1", Tape().key(turned))
    tape = Tape().start(71, 6, 4, 3).empty().start(72, 9, 2, 0).empty().start(73, 2, 7, 15)
    yield playing("key-other-shapes-later", "key", "1.4-2 3.1-1", tape, index=True)
    yield playing(
        "key-first-index-7", "key container", "1.4-1 1.4-2", Tape().start(74, 3, 2, frame=7).empty(), index=True
    )
    yield playing("key-last-index", "key container", "1.4-1", Tape().start(75, 3, 2, frame=0xFFFFFFFF), index=True)


def _metas() -> Iterator[Vector]:
    base = key_sections(scene(80, 2), layout(80, 2, 1))

    def told(meta: bytes, *, frame: bool = False) -> Tape:
        return Tape().key({**base, "meta": meta if frame else plain_frame(meta)})

    def put(**values: Any) -> bytes:
        return meta_json(lambda meta: meta.update(values))

    yield playing("meta-compressed", "meta", "3.2-1 3.2-2 3.2-3", told(compress(meta_json()), frame=True))
    more = put(
        extra={"note": "a longer text, a longer text, of which much comes again " * 40, "list": list(range(900))}
    )
    yield playing("meta-compressed-longer", "meta", "3.2-1 3.2-3", told(compress(more), frame=True))
    frame = plain_frame(meta_json())
    for size, flag in ((1, 1), (2, 2), (4, 3)):
        nameless = frame[:4] + bytes([frame[4] | flag]) + bytes(size) + frame[5:]
        yield playing(f"meta-dictionary-0-of-{size}-bytes", "meta", "3.2-2", told(nameless, frame=True))
    yield playing("meta-unknown-entries", "meta", "3.2-9", told(put(lens={"k1": 0.1}, later=None)))
    deep = b"[" * 98 + b"]" * 98
    yield playing("meta-100-deep", "meta", "3.2-5", told(put(extra={"a": "X"}).replace(b'"X"', deep)))
    brackets = put(extra={"a": "[" * 300 + '"' + "\\" + "{" * 300})
    yield playing("meta-brackets-in-texts", "meta", "3.2-5", told(brackets))
    yield playing("meta-spaces", "meta", "3.2-4", told(b"\n\t " + meta_json().replace(b",", b" ,\r\n") + b" "))
    yield playing(
        "meta-whole-numbers",
        "meta cameras",
        "3.2-6 3.3-1",
        told(_rig("width", b"32", b"3.2e1").replace(b'"height":32', b'"height":32.0')),
    )
    yield from _numbers(told)
    yield playing(
        "meta-entry-twice", "meta", "3.2-6", told(meta_json().replace(b'"fps":30.0', b'"fps":"x","fps":30.0'))
    )
    yield playing("meta-fps-limits", "meta", "3.2-7", told(put(fps=100000), frame=False))
    ids = ["a" * 120, "ü" * 60, "com10", "a.b c", "con-", "\U0001f3a5"]
    yield playing("meta-camera-ids", "meta cameras", "3.3-2", told(_cameras(ids)))
    yield playing("meta-only-test-cameras", "meta cameras", "3.3-1", told(put(train=_of([]), test=_of(["t"]))))
    yield playing(
        "meta-largest-picture", "meta cameras", "3.3-3", told(put(train={**_of(["a"]), "width": 65536, "height": 2048}))
    )
    turn = World((0.0, -0.8, 0.6, 1.0, 0.0, 0.0, 0.0, 0.6, 0.8), (500000.25, 5200000.5, 300.125), 100.0)
    world = {"rotation": turn.rotation, "offset": turn.offset, "scale": turn.scale}
    yield playing("meta-world", "meta world", "3.4-1", told(put(world=world)))
    both = layered(
        {**key_sections(scene(81, 3), layout(81, 3, 1), first=np.arange(3) == 1), "meta": compress(put(world=world))}
    )
    yield playing("layers-meta-compressed", "layers meta", "3.8-3 3.8-4", Tape().key(both))


def _numbers(told: Callable[[bytes], Tape]) -> Iterator[Vector]:
    """Numbers of meta that count by their value in float64, whatever their text says."""
    long = _rig("width", b"32", b"32.00000000000000000001").replace(b'"height":32', b'"height":320000000e-7')
    yield playing("meta-whole-by-its-value", "meta cameras", "3.2-6 3.3-1 3.3-3", told(long))
    for name, focal in (("least-determinant", (1e-6, 1.000002e-6)), ("determinant-beyond-float32", (3e38, 3e38))):
        value = json.loads(meta_json())
        value["train"] = {**_of(["a"]), "Ks": [[focal[0], 0, 16, 0, focal[1], 16, 0, 0, 1]]}
        text = json.dumps(value, separators=(",", ":")).encode()
        yield playing(f"meta-{name}", "meta cameras", "3.3-6", told(text))


def _of(ids: list[str]) -> dict[str, Any]:
    pose, K = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1], [40, 0, 16, 0, 40, 16, 0, 0, 1]
    return {"ids": ids, "width": 32, "height": 32, "near": 0.25, "viewmats": [pose] * len(ids), "Ks": [K] * len(ids)}


def _cameras(ids: list[str]) -> bytes:
    return meta_json(lambda meta: meta.update(train=_of(ids)))


def _rig(name: str, old: bytes, new: bytes) -> bytes:
    entry = b'"' + name.encode() + b'":'
    return meta_json().replace(entry + old, entry + new)
