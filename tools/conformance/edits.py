"""Vectors of rows that leave and join, and of files: versions, the index, cuts, empty packets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gsstream.core.changes import AddedGaussians, Delta, RowEdit
from tools.conformance.moving import motion, moves, section, written
from tools.conformance.residuals import residual
from tools.conformance.tapes import Tape, Vector, file_of, playing, scene


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _rows()
    yield from _followers()
    yield from _files()


def added(tape: Tape, seed: int, nodes: Sequence[int], new: int = 0, rest: int | None = None) -> AddedGaussians:
    """Return rows that join these nodes, ascending; ``new`` nodes come with them."""
    layout, rng = tape.here.layout, np.random.default_rng(seed)
    old = len(layout.node_counts)
    rest = tape.here.gaussians.shN.shape[1] if rest is None else rest
    units = rng.integers(0, len(layout.units), len(nodes)).astype(np.uint8)
    parents = old + np.arange(new) - rng.integers(0, 2, new).clip(0, max(old, 0))
    parents = np.maximum(parents, 0)
    return AddedGaussians(scene(seed, len(nodes), rest), np.array(nodes, np.int64), units, parents)


def edit(tape: Tape, joins: AddedGaussians | None, *leaves: int) -> Tape:
    """Add a delta of rows that leave and join."""
    return tape.change(Delta((RowEdit(joins, np.array(leaves, np.int64)),)))


def _rows() -> Iterator[Vector]:
    for degree, rest in ((0, 0), (1, 3), (2, 8), (3, 15)):
        tape = Tape().start(300 + degree, 12, 6, rest)
        edit(tape, added(tape, 1, [0, 0, 3, 5]))
        edit(tape, added(tape, 2, [1, 6, 6, 8], 3), 0, 5, 6)
        tape.delta(residual(tape, 3, ["means", "sh0"]))
        yield playing(f"rows-degree-{degree}", "rows harmonics", "4.7-1 4.7-2 4.7-4 4.7-5 4.7-6 4.7-7", tape)
    tape = Tape().start(310, 12, 6, 3)
    edit(tape, None, 0, 11)
    edit(tape, None, *range(10))
    edit(tape, added(tape, 1, [2, 2, 4])).empty()
    edit(tape, added(tape, 2, [0, 7], 2), 0, 1, 2)
    yield playing("rows-all-leave", "rows empty-scene", "4.7-1 4.7-3", tape)
    for degree, rest in ((0, 0), (1, 3), (2, 8), (3, 15)):
        tape = Tape().start(311, 0, 2, rest)
        edit(tape, added(tape, 1, [0, 1, 2], 1))
        tape.delta(residual(tape, 3, ["means", *(["shN"] if rest else [])]))
        yield playing(f"rows-join-an-empty-scene-degree-{degree}", "rows empty-scene", "4.7-7 3.5-4", tape)
    tape = Tape().start(312, 0, 0, 0)
    yield playing("rows-first-node", "rows empty-scene", "4.7-4", edit(tape, added(tape, 1, [0, 0], 1)))
    tape = Tape().start(313, 9, 3, 0)
    edit(tape, added(tape, 1, [1], 20))
    tape.delta(residual(tape, 3, ["means"], share=1.0))
    yield playing("rows-new-nodes-stay-empty", "rows", "4.7-3 4.7-4", tape)
    tape = Tape().start(314, 40, 12, 3)
    for seed in range(6):
        nodes = np.sort(np.random.default_rng(seed).integers(0, len(tape.here.layout.node_counts) + 1, 5))
        edit(tape, added(tape, seed, nodes.tolist(), 1), *range(seed, len(tape.here.gaussians), 5))
    yield playing("rows-in-every-frame", "rows", "4.7-1 4.7-5", tape, index=True)


def _followers() -> Iterator[Vector]:
    tape = Tape().start(320, 30, 10, 0)
    for seed in range(4):
        change = motion(tape.here.scene, seed, predicted=seed > 0)
        nodes = [0, 0, 4, 9] if seed % 2 else [0, 5, 10]
        joins = added(tape, seed, nodes, 0 if seed % 2 else 1)
        tape.change(Delta((change, RowEdit(joins, np.array([0, 3, 7]) if seed else np.zeros(0, np.int64)))))
    moves(tape, motion(tape.here.scene, 9, still=True))
    yield playing("rows-follow-groups", "rows motion", "4.3-1 4.4-6", tape)
    tape = Tape().start(321, 10, 4, 0)
    moves(tape, motion(tape.here.scene, 1, predicted=False))
    tape.change(Delta((motion(tape.here.scene, 2), RowEdit(added(tape, 3, [1, 2, 2]), np.arange(10)))))
    moves(tape, motion(tape.here.scene, 4))
    yield playing("rows-all-exchanged-forget-groups", "rows motion", "4.4-6", tape)
    tape = Tape().start(322, 12, 6, 3)
    change = motion(tape.here.scene, 1, predicted=False)
    more = residual(tape, 2, ["means", "quats", "shN"], levels=3)
    tape.delta([("motion", section(written(change))), *more])
    both = Delta((motion(tape.here.scene, 3), RowEdit(added(tape, 4, [0, 2], 0), np.array([1, 2]))))
    tape.change(both).delta(residual(tape, 5, ["sh0", "shN"], latents=1))
    yield playing("rows-with-all-other-changes", "rows motion residual", "4.2-2", tape)


def _files() -> Iterator[Vector]:
    tape = Tape().start(330, 8, 4, 3)
    for seed in range(3):
        tape.delta(residual(tape, seed, ["means"], pattern=None)).empty()
    tape.start(331, 8, 4, 3).empty()
    whole = tape.bytes(index=True)
    yield playing("file-with-index", "container index", "1.5-1 1.5-2 1.5-3 1.5-4 1.4-3", whole)
    plain = tape.bytes()
    yield playing("file-without-index", "container empty-packet", "1.4-2 1.3-5 4.8-1", plain)
    yield playing("file-of-version-2.0", "container versions", "1.1-5", tape.bytes(minor=0))
    newer = Tape().start(332, 8, 4, 3)
    newer.delta(residual(newer, 1, ["means", "sh0"]))
    yield playing("file-of-version-2.1", "container versions pattern", "1.1-5", newer.bytes(minor=1, index=True))
    for minor in (2, 3):
        name = f"file-of-version-2.{minor}"
        yield playing(name, "container versions pattern", "1.1-5", newer.bytes(minor=minor))
    yield playing(
        "file-layers-in-version-2.0",
        "container versions layers",
        "1.1-5",
        Tape().start(333, 6, 2, first=np.arange(6) < 2).bytes(minor=0),
    )
    last = len(tape.packets[-1])
    yield playing("cut-in-a-header", "container cut", "1.6-1", plain[: -last + 9])
    yield playing("cut-after-a-header", "container cut", "1.6-1", newer.bytes()[: -len(newer.packets[-1]) + 16])
    yield playing("cut-in-a-body", "container cut", "1.6-1 0.1-2", newer.bytes()[:-1])
    yield playing("cut-in-the-index", "container cut index", "1.6-1", whole[:-5])
    strange = Tape().start(334, 3, 2).lie(Tape().start(335, 3, 2, frame=9).packets[0])
    yield playing("cut-packet-out-of-order", "container cut", "1.6-1", strange.bytes()[:-1])
    yield playing("cut-bytes-after-the-index", "container cut index", "1.6-1", whole + b"\1" * 15)
    yield playing("file-late-join", "container", "1.4-1", file_of(tape.packets[-2:]))
