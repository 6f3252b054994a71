"""Delta packets whose motions or field are refused, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tools.conformance.coding import constant, parts, run_gates
from tools.conformance.keys import flat
from tools.conformance.lying_files import begun
from tools.conformance.moving import field_of, motion, moves, section, written
from tools.conformance.tapes import Tape, Vector, key_sections, layout, meta_json, plain_frame, refusing, scene

NAN, INFINITY = float("nan"), float("inf")


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _motions()
    yield from _ranges()
    yield from _fields()


def _motions() -> Iterator[Vector]:
    sound = motion(begun().here.scene, 1, share=1.0)
    data, groups = written(sound), len(sound.moving)

    def head(**said: Any) -> Tape:
        values = {"flags": 1, "bins": 2, "cell": 1.0, "translation": 0.5, "rotation": 0.5, **said}
        return begun().refused([("motion", section(struct.pack("<BBfff", *values.values()) + data[14:]))])

    cases: dict[str, tuple[Tape, str]] = {
        "none": (begun().refused([("motion", b"\0")]), "4.4-1"),
        "no-byte": (begun().refused([("motion", b"")]), "4.4-1 1.3-6"),
        "nine": (begun().refused([("motion", b"\x09" + parts(*[data] * 9))]), "4.4-1"),
        "flag-4": (head(flags=5), "4.4-2"),
        "no-bins": (head(bins=0), "4.4-3"),
        "17-bins": (head(bins=17), "4.4-3"),
        "cut": (begun().refused([("motion", b"\1" + data[:13])]), "1.3-6"),
        "cut-behind-its-head": (begun().refused([("motion", b"\1" + data[:14])]), "2.2-2 1.3-6"),
        "two-levels": (_moved(run_gates([groups], 1, 2, [1] * groups), constant(0, groups, 6)), "2.8-7"),
        "of-another-number-of-groups": (_moved(run_gates([1] * (groups + 1), 0), b""), "2.8-2"),
        "symbols-of-nobody": (_moved(run_gates([groups], 0), constant(0, 1, 6)), "2.3-1"),
    }
    for name, value in (("0", 0.0), ("below-0", -1.0), ("a-billion", 1e9), ("nan", NAN), ("infinite", INFINITY)):
        for field in ("cell", "translation", "rotation") if name in ("0", "a-billion") else ("cell",):
            cases[f"{field}-{name}"] = (head(**{field: value}), "4.4-4")
    for name, channel in (("translation", 1), ("rotation", 4)):
        symbols = np.zeros((groups, 6), np.int32)
        symbols[0, channel] = -(1 << 31)
        large = replace(sound, symbols=symbols)
        if name == "translation":
            large = replace(large, translation_step=float(np.float32(9e8)))
        else:
            large = replace(large, rotation_step=float(np.float32(9e8)))
        tape = begun().refused([("motion", section(written(large)))])
        cases[f"{name}-too-large"] = (tape, "4.4-5")
    for name, (tape, rules) in cases.items():
        yield refusing(f"motion-{name}", "motion", rules, tape)


def _moved(marks: bytes, table: bytes) -> Tape:
    return begun().refused([("motion", section(struct.pack("<BBfff", 0, 2, 1, 1, 1) + parts(marks, table)))])


def _ranges() -> Iterator[Vector]:
    """A shift that is predicted eight times in each frame grows eightfold, until it leaves float32."""
    tape = Tape().start(480, 6, 2, 0)
    whole = motion(tape.here.scene, 1, share=1.0, predicted=False, still=True)
    symbols = np.zeros_like(whole.symbols)
    symbols[:, 0] = 1 << 30
    moves(tape, replace(whole, symbols=symbols, translation_step=float(np.float32(9e8))))
    on = replace(whole, predicted=True)
    for _ in range(22):
        moves(tape, *[on] * 8)
    tape.refused([("motion", section(*[written(on)] * 8))])
    yield refusing("motion-beyond-float32", "motion extremes", "4.4-7", tape)


#: Fields of a field's head: where they lie and of which type.
PLACES = {
    "flags": (0, "B"),
    "levels": (1, "B"),
    "entries": (2, "B"),
    "features": (3, "B"),
    "width": (4, "B"),
    "layers": (5, "B"),
    "base": (6, "H"),
    "entry-step": (12, "I"),
    "weight-step": (16, "I"),
    "growth": (20, "f"),
    "reach": (24, "f"),
    "lower": (28, "f"),
    "upper": (40, "f"),
}


def _fields() -> Iterator[Vector]:
    state = begun()
    change = field_of(state.here.scene, 1, share=None)
    data = _field(change)
    lies: Mapping[str, tuple[str, tuple[float, ...]]] = {
        "flags": ("4.5-1", (2,)),
        "levels": ("4.5-2", (0, 17)),
        "entries": ("4.5-2", (0, 21)),
        "features": ("4.5-2", (0, 9)),
        "width": ("4.5-2", (0, 129)),
        "layers": ("4.5-2", (0, 5)),
        "base": ("4.5-2", (0, 1025)),
        "entry-step": ("4.5-3", (0, (1 << 25) + 1)),
        "weight-step": ("4.5-3", (0, (1 << 17) + 1)),
        "growth": ("4.5-4", (0.5, 4.5, NAN)),
        "reach": ("4.5-4", (0, -1, 1e9, NAN)),
        "lower": ("4.5-4", (9.0, NAN, -INFINITY)),
        "upper": ("4.5-4", (-9.0, INFINITY)),
    }
    for name, (rule, values) in lies.items():
        at, kind = PLACES[name]
        for value in values:
            lied = data[:at] + struct.pack(f"<{kind}", value) + data[at + struct.calcsize(kind) :]
            yield refusing(f"field-{name}-{value:g}", "field", rule, begun().refused([("field", lied)]))
    entries = data[:1] + b"\x02\x14" + data[3:]
    yield refusing("field-two-levels-of-2-20", "field", "4.5-2", begun().refused([("field", entries)]))
    cells = data[:1] + b"\x10" + data[2:6] + struct.pack("<H", 1024) + data[8:20] + struct.pack("<f", 4) + data[24:]
    yield refusing("field-too-many-cells", "field", "4.5-5", begun().refused([("field", cells)]))
    for name, base in (("beyond-32-bits", 3), ("of-2-32", 4)):  # base times 4^15; the second is 0 in 32 bits
        many = cells[:6] + struct.pack("<H", base) + cells[8:]
        yield refusing(f"field-cells-{name}", "field", "4.5-5", begun().refused([("field", many)]))
    yield refusing("field-cut", "field", "1.3-6", begun().refused([("field", data[:51])]))
    yield refusing("field-without-parts", "field", "2.2-2 1.3-6", begun().refused([("field", data[:52])]))
    assert data[52] == 0, "the part of marks is empty"
    marks = run_gates([6], 1)
    yield refusing(
        "field-marks-unasked",
        "field",
        "4.5-7",
        begun().refused([("field", data[:52] + bytes([len(marks)]) + marks + data[53:])]),
    )
    two = run_gates([6], 1, 2, [1] * 6)
    marked = b"\1" + data[1:52] + bytes([len(two)]) + two + data[53:]
    yield refusing("field-marks-of-two-levels", "field", "2.8-7", begun().refused([("field", marked)]))
    for name, at in (("entry", 12), ("weight", 16)):
        step = (1 << 25, 1 << 17)[name == "weight"]
        lied = data[:at] + struct.pack("<I", step) + data[at + 4 :]
        yield refusing(f"field-{name}-symbols-too-large", "field", "4.5-8", begun().refused([("field", lied)]))
    yield _long_field()


def _field(change: Any) -> bytes:
    from gsstream.packet.changes.field import encode_field

    ((_, data),) = encode_field(change)
    return data


def _long_field() -> Vector:
    """More rows than a network of this size may take: 520,000 equal ones, behind a meta that pays for them."""
    number = 520_000
    stored = struct.pack("<IIBf", number, 1, 1, 1.0) + parts(constant(number, 1), constant(0, number))
    long = meta_json(lambda meta: meta.update(extra={"note": "a" * 7200}))
    tape = Tape().key(
        {
            **key_sections(scene(490, 0), layout(490, 0, 0, ())),
            "meta": plain_frame(long),
            "layout": stored,
            **flat(number),
        }
    )
    head = struct.pack("<BBBBBBHIII8f", 0, 16, 4, 8, 128, 4, 1, 0, 1, 1, 1, 1, -1, -1, -1, 1, 1, 1)
    tape.refused([("field", head + parts(*[b""] * 22))])
    return refusing("field-takes-too-long", "field limits", "4.5-6", tape)
