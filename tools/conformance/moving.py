"""Vectors of motions and fields: predicted and from rest, groups of every kind, large turns, grids of every shape."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.changes import Delta, Field, FieldShape, Motion, Scene, apply_motion, field_rows, groups_for
from gsstream.core.shapes import IntArray
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols
from tools.conformance.coding import parts
from tools.conformance.residuals import residual
from tools.conformance.tapes import Tape, Vector, playing

HALF = struct.Struct("<BBfff")


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _motions()
    yield from _groups()
    yield from _turns()
    yield from _histories()
    yield from _fields()


def motion(
    scene: Scene,
    seed: int,
    *,
    cell: float = 1.0,
    bins: int = 2,
    share: float = 0.7,
    size: float = 2.0,
    still: bool = False,
    predicted: bool = True,
    regroup: bool = False,
) -> Motion:
    """Return a motion of a share of the scene's groups; ``still``: without any correction."""
    rng = np.random.default_rng(seed)
    groups = groups_for(scene, cell, bins, regroup)
    moving = (rng.random(groups.count) < share).astype(np.uint8)
    symbols = np.rint(rng.laplace(size=(int(moving.sum()), 6)) * size).astype(np.int32) * (not still)
    return Motion(cell, bins, moving, symbols, 0.0625, 0.03125, predicted=predicted, regroup=regroup)


def section(*motions: bytes) -> bytes:
    """Return the section motion."""
    return bytes([len(motions)]) + parts(*motions)


def written(change: Motion) -> bytes:
    """Return one motion of the section, with whatever steps and cell it has."""
    flags = change.predicted | change.regroup << 1
    head = HALF.pack(flags, change.brightness_bins, change.cell, change.translation_step, change.rotation_step)
    return head + parts(encode_gates(change.moving, 1), encode_symbols(change.symbols))


def moves(tape: Tape, *changes: Motion) -> Tape:
    """Add a delta of motions."""
    return tape.delta([("motion", section(*map(written, changes)))])


def _motions() -> Iterator[Vector]:
    for predicted, regroup, bins in itertools.product((False, True), (False, True), (1, 2, 16)):
        tape = Tape().start(200 + bins, 24, 10, 3)
        for frame in range(3):
            moves(tape, motion(tape.here.scene, frame, bins=bins, predicted=predicted, regroup=regroup))
        kind = "predicted" if predicted else "rest"
        name = f"motion-{kind}-{bins}-bins{'-regrouped' if regroup else ''}"
        features = f"motion motion-{kind} {'regroup' if regroup else ''}"
        yield playing(name, features, "4.3-1 4.4-2 4.4-3 4.4-6 0.4-1", tape)
    tape, scene, several = Tape().start(220, 40, 10, 0), None, []
    for level in range(8):
        scene = tape.here.scene if scene is None else scene
        several.append(motion(scene, level, cell=float(np.float32(3.0 / 1.5**level)), predicted=level % 2 == 0))
        scene, _ = apply_motion(scene, several[-1])
    moves(tape, *several)
    moves(tape, motion(tape.here.scene, 9, cell=several[-1].cell))
    yield playing("motion-eight-at-once", "motion", "4.4-1 4.4-6", tape)


def _groups() -> Iterator[Vector]:
    for name, cell, spread in (
        ("tiny", 1e-6, 3.0),
        ("huge", 9e8, 3.0),
        ("subnormal", 1e-42, 1.0),
        ("far", 0.001, 100.0),
    ):
        tape = Tape().start(230, 20, 6, 0, spread=spread)
        for frame in range(2):
            moves(tape, motion(tape.here.scene, frame, cell=float(np.float32(cell)), bins=3))
        yield playing(f"motion-cell-{name}", "motion groups", "4.4-4 4.4-6", tape)
    tape = Tape().start(231, 30, 8, 0)
    first = motion(tape.here.scene, 1, cell=2.0)
    moves(tape, first)
    moves(tape, motion(tape.here.scene, 2, cell=0.5))
    moves(tape, motion(tape.here.scene, 3, cell=0.5, bins=3))
    tape.delta(residual(tape, 4, ["means", "sh0"]))
    moves(tape, motion(tape.here.scene, 5, cell=0.5, bins=3))
    yield playing("motion-groups-kept-and-changed", "motion groups residual", "4.4-6", tape)
    tape = Tape().start(232, 0, 3, 0)
    none = Motion(1.0, 1, np.zeros(0, np.uint8), np.zeros((0, 6), np.int32))
    moves(tape, none)
    yield playing("motion-of-no-rows", "motion empty-scene", "4.4-5 2.8-2", tape)
    tape = Tape().start(233, 20, 6, 0)
    moves(tape, motion(tape.here.scene, 0, share=0.0))
    moves(tape, motion(tape.here.scene, 1, share=1.0, predicted=False, still=True))
    yield playing("motion-nothing-moves", "motion", "4.3-1", tape)


def _turns() -> Iterator[Vector]:
    tape = Tape().start(240, 16, 4, 0)
    large = motion(tape.here.scene, 1, predicted=False)
    # Turns of up to almost 180 degrees: of more than 120, nothing is remembered.
    turned = large.symbols.copy()
    turned[:, 3:] *= 40
    moves(tape, replace(large, symbols=turned))
    moves(tape, motion(tape.here.scene, 2))
    moves(tape, motion(tape.here.scene, 3, still=True))
    yield playing("motion-turns-beyond-120-degrees", "motion", "4.3-1 0.4-1", tape)
    tape = Tape().start(241, 8, 4, 0)
    whole = motion(tape.here.scene, 1, predicted=False, share=1.0)
    far = np.zeros_like(whole.symbols)
    far[:, 0], far[:, 3] = 2**31 - 1, 1
    moves(tape, replace(whole, symbols=far, translation_step=0.5, rotation_step=float(np.float32(9e8))))
    far = np.zeros_like(whole.symbols)
    far[:, 1] = -(2**31)
    moves(tape, replace(whole, symbols=far, translation_step=float(np.float32(4e8)), predicted=True))
    moves(tape, replace(whole, symbols=np.zeros_like(far)))
    yield playing("motion-largest-corrections", "motion extremes", "4.4-5", tape)
    # Quaternions and centres that become -0, and a residual of zeros over them.
    tape = Tape().start(242, 12, 6, 0)
    half = motion(tape.here.scene, 1, predicted=False, share=1.0)
    turned = np.zeros_like(half.symbols)
    turned[:, 3] = 1 << 30
    moves(tape, replace(half, symbols=turned, rotation_step=float(np.float32(9e8))))
    for seed in range(3):
        tape.delta(residual(tape, seed, ["means", "quats"], pattern="random", latents=2 * (seed == 1)))
    yield playing("motion-half-turns-then-residuals", "motion residual extremes", "0.4-1", tape)


def _histories() -> Iterator[Vector]:
    def go(tape: Tape, seed: int, **said: Any) -> Tape:
        return moves(tape, motion(tape.here.scene, seed, **said))

    tape = go(Tape().start(250, 24, 8, 0), 1, predicted=False)
    tape.delta(residual(tape, 2, ["means", "quats", "scales"]))
    yield playing("motion-predicted-from-a-residual", "motion residual", "4.3-1", go(tape, 3, still=True))
    tape = go(go(Tape().start(251, 24, 8, 0), 1, predicted=False).empty(), 2)
    yield playing("motion-after-an-empty-packet", "motion empty-packet", "4.8-1 4.3-1", tape)
    tape = go(Tape().start(252, 24, 8, 0), 1, predicted=False).start(253, 24, 8, 0)
    yield playing("motion-after-a-key-packet", "motion key", "4.4-6", go(go(tape, 2), 3))
    tape = Tape().start(254, 24, 8, 3)
    for seed in range(3):
        change = motion(tape.here.scene, seed, predicted=seed > 0)
        more = residual(tape, seed, ["means", "quats", "opacities", "shN"], levels=3, latents=2 * (seed == 1))
        tape.delta([("motion", section(written(change))), *more])
    yield playing("motion-and-residual", "motion residual", "4.2-2 4.3-1", tape)
    tape = Tape().start(255, 150, 30, 8)
    for seed in range(12):
        change = motion(tape.here.scene, seed, predicted=seed % 4 > 0, regroup=seed % 5 == 4, size=1.0)
        more = residual(tape, seed, ["means", "sh0"], share=0.2) if seed % 3 else []
        tape.delta([("motion", section(written(change))), *more])
    yield playing("motion-twelve-frames", "motion residual", "4.3-1 4.4-6 0.4-1", tape)


def field_of(scene: Scene, seed: int, *, share: float | None = 0.6, size: int = 9, **said: Any) -> Field:
    """Return a field over the middle of the scene; ``share`` of its rows are marked, None: all in the box move."""
    rng = np.random.default_rng(seed)
    small = {
        "levels": 3,
        "entries": 6,
        "features": 2,
        "base": 3,
        "growth": 1.5,
        "width": 5,
        "layers": 2,
        "seed": said.pop("drawn", seed),
    }
    steps = said.pop("steps", (1 << 14, 1 << 8))
    box = said.pop("box", ((-1.25, -1.0, -1.0), (1.0, 1.0, 1.5), 0.5))
    shape = FieldShape(*box, **{**small, **said})
    marks = None if share is None else (rng.random(len(scene.gaussians)) < share).astype(np.uint8)
    _, unit = field_rows(scene, shape, marks)
    sizes = [(len(which), shape.features) for which in shape.touched(unit)]
    sizes += zip(shape.widths[:-1], shape.widths[1:], strict=True)
    tables: tuple[IntArray, ...] = tuple(rng.integers(-size, size + 1, each).astype(np.int32) for each in sizes)
    return Field(shape, marks, tables[: shape.levels], tables[shape.levels :], *steps)


def _fields() -> Iterator[Vector]:
    shapes: list[tuple[str, dict[str, Any]]] = [
        ("marked", {}),
        ("all-in-the-box", {"share": None}),
        ("nobody-marked", {"share": 0.0}),
        ("nobody-in-the-box", {"share": None, "box": ((90.0, 90.0, 90.0), (91.0, 91.0, 91.0), 0.5)}),
        ("one-level-one-layer", {"levels": 1, "layers": 1, "features": 1, "base": 1, "growth": 1.0, "width": 1}),
        ("four-layers", {"layers": 4, "width": 9}),
        ("sixteen-levels", {"levels": 16, "entries": 4, "growth": 1.875, "features": 1, "width": 3}),
        ("dense-levels", {"entries": 12, "base": 4, "growth": 1.75}),
        ("hashed-levels", {"entries": 3, "base": 200, "growth": 2.5}),
        ("eight-features", {"features": 8, "width": 16}),
        ("wide", {"width": 128, "layers": 1, "features": 1, "levels": 2}),
        ("largest-steps", {"size": 0, "steps": (1 << 25, 1 << 17)}),
        (
            "largest-weights",
            {"size": 30000, "steps": (1000, 4), "box": ((-2.0,) * 3, (2.0,) * 3, float(np.float32(9e8)))},
        ),
        ("last-seed", {"drawn": 0xFFFFFFFF, "share": None}),
    ]
    for number, (name, said) in enumerate(shapes):
        tape = Tape().start(260 + number, 20, 8, 0)
        tape.change(Delta((field_of(tape.here.scene, number, **said),)))
        tape.change(Delta((motion(tape.here.scene, number),)))
        yield playing(f"field-{name}", "field motion", "4.5-2 4.5-3 4.5-4 4.5-7 4.5-8", tape)
    tape = Tape().start(280, 24, 8, 3)
    for seed in range(2):
        change = motion(tape.here.scene, seed)
        there, _ = apply_motion(tape.here.scene, change)
        made = Delta((change, field_of(there, seed)))
        more = residual(tape, seed, ["means", "quats", "sh0"])
        tape.change(made) if seed else tape.delta([*_sections(tape, made), *more])
    yield playing("field-between-motion-and-residual", "field motion residual", "4.2-2 4.3-1", tape)
    tape = Tape().start(281, 0, 2, 0)
    yield playing(
        "field-of-no-rows", "field empty-scene", "4.5-6 4.5-7", tape.change(Delta((field_of(tape.here.scene, 1),)))
    )


def _sections(tape: Tape, delta: Delta) -> list[tuple[str | int, bytes]]:
    from gsstream.packet import encode_delta
    from gsstream.packet.base import parse_packet

    made = encode_delta(delta, tape.here.layout, tape.here.decoders, frame=tape.next)
    return [(name, found.data) for name, found in parse_packet(made.data)[1].items()]
