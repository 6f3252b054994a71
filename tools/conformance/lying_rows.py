"""Delta packets whose rows that leave and join are refused, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from tools.conformance.coding import bits, column, constant, parts, run_gates
from tools.conformance.edits import added, edit
from tools.conformance.keys import flat
from tools.conformance.lying_files import begun
from tools.conformance.tapes import Tape, Vector, refusing

NAN, INFINITY = float("nan"), float("inf")


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _rows()


def joining(
    number: int = 2,
    new: int = 1,
    parents: bytes | None = None,
    nodes: bytes | None = None,
    counts: bytes | None = None,
    units: bytes | None = None,
    rest: int = 9,
    head: bytes | None = None,
) -> bytes:
    """Return the section added, sound but for what is said."""
    rows = flat(number if number < 1000 else 1)
    rows["shN"] = struct.pack("<bB", 7, rest) + constant(0, number, rest)
    return parts(
        bits(("gamma", number - 1), ("gamma", new)) if head is None else head,
        constant(1, new) if parents is None else parents,
        run_gates([1, 4], 1) if nodes is None else nodes,
        constant(number, 1) if counts is None else counts,
        constant(0, number) if units is None else units,
        *rows.values(),
    )


def _rows() -> Iterator[Vector]:
    sound = begun()
    edit(sound, added(sound, 1, [0, 4], 1))
    begun().delta([("added", joining())])
    leaving = {
        "rows-nobody-leaves": (run_gates([6], 0), "4.7-1"),
        "rows-more-leave-than-are-there": (run_gates([7, 1], 0), "2.8-4"),
        "rows-removed-without-parts": (b"\xa8", "2.2-2 1.3-6"),
    }
    for name, (data, rules) in leaving.items():
        yield refusing(name, "rows", rules, begun().refused([("removed", data)]))
    empty = Tape().start(495, 0, 2, 3).refused([("removed", parts(b"\xc0", b"", b"", b""))])
    yield refusing("rows-leave-an-empty-scene", "rows empty-scene", "4.7-1", empty)
    cases = {
        "head-longer": (joining(head=bits(("gamma", 1), ("gamma", 1)) + b"\0"), "4.7-2 2.1-3"),
        "head-padding": (joining(head=bits(("gamma", 1), ("gamma", 1), ("bits", 1, 1))), "4.7-2 2.1-3"),
        "more-than-the-section-pays-for": (joining(head=bits(("gamma", 99_999), ("gamma", 1))), "4.7-3 1.8-1"),
        "most": (joining(head=bits(("gamma", (1 << 35) - 2), ("gamma", 1))), "4.7-3 1.8-1"),
        "more-nodes-than-the-section-pays-for": (joining(head=bits(("gamma", 1), ("gamma", 99_999))), "4.7-3 1.8-1"),
        "parent-behind-it": (joining(parents=constant(-1, 1)), "4.7-4"),
        "parent-before-the-first": (joining(parents=constant(5, 1)), "4.7-4"),
        "nodes-of-two-levels": (joining(nodes=run_gates([1, 4], 1, 2, [1])), "2.8-7"),
        "counts-too-few": (joining(counts=constant(1, 1)), "4.7-5"),
        "counts-too-many": (joining(counts=constant(3, 1)), "4.7-5"),
        "count-of-0": (joining(nodes=run_gates([2, 3], 1), counts=column([2, 0])), "4.7-5"),
        "no-node-open": (joining(nodes=run_gates([5], 0), counts=b""), "4.7-5"),
        "unit-beyond-the-last": (joining(units=constant(3, 2)), "4.7-6"),
        "unit-below-0": (joining(units=constant(-1, 2)), "4.7-6"),
        "other-harmonics": (joining(rest=24), "4.7-7"),
        "no-harmonics": (joining(rest=0), "4.7-7"),
        "no-such-harmonics": (joining(rest=12), "3.6-2 4.7-7"),
        "cut": (joining()[:-30], "2.2-2 1.3-6"),
        "no-byte": (b"", "2.2-2 1.3-6"),
    }
    for name, (data, rules) in cases.items():
        yield refusing(f"rows-join-{name}", "rows", rules, begun().refused([("added", data)]))
    none = Tape().start(496, 0, 0, 3, units=())
    data = joining(new=0, parents=b"", nodes=parts(b"\xc0", b"", b"", b""), counts=b"")
    yield refusing("rows-join-no-node", "rows empty-scene", "4.7-5 4.7-6", none.refused([("added", data)]))
