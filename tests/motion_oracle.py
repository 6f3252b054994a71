"""Section 4.4 of docs/spec in plain Python, written from its text alone: an oracle for motions.

Numbers are Python floats (float64), rows are lists, and float32 is what ``struct`` makes of a number. It shares no code
with gsstream.core.changes: where the two differ in a bit, the text or one of them is wrong.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from typing import Any

Row = list[float]


def f32(value: float) -> float:
    """The nearest float32; beyond the largest, infinity."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


@dataclass
class World:
    """What a player keeps: rows, the groups that the last motion named, what the last frame displaced."""

    means: list[Row]
    quats: list[Row]
    sh0: list[Row]
    named: tuple[float, int] | None = None
    group_of: list[int] = field(default_factory=list)
    count: int = 0
    moved: dict[int, tuple[Row, Row]] = field(default_factory=dict)

    @classmethod
    def of(cls, gaussians: Any) -> World:
        """A scene after a key packet."""
        return cls(gaussians.means.tolist(), gaussians.quats.tolist(), gaussians.sh0[:, 0].tolist())

    def form_groups(self, cell: float, brightness_bins: int, regroup: bool) -> None:
        """Paragraph "Groups"."""
        if self.named == (cell, brightness_bins) and not regroup:
            return
        keys = []
        for mean, (red, green, blue) in zip(self.means, self.sh0, strict=True):
            index = [min(max(math.floor(x / cell), -32768), 32767) for x in mean]
            bright = 0.5 + 0.28209479177387814 * (0.25 * red + 0.5 * green + 0.25 * blue)
            keys.append((*index, min(max(math.floor(bright * brightness_bins), 0), brightness_bins - 1)))
        number = {key: i for i, key in enumerate(sorted(set(keys)))}
        self.named, self.group_of, self.count = (cell, brightness_bins), [number[key] for key in keys], len(number)

    def move(self, motion: Any) -> set[int]:
        """Paragraphs "Transform of a moving group" and "Applied to a row"; returns the rows of moving groups."""
        self.form_groups(motion.cell, motion.brightness_bins, motion.regroup)
        marks = [int(mark) for mark in motion.moving]
        assert len(marks) == self.count
        moving = [group for group in range(self.count) if marks[group]]
        touched: set[int] = set()
        for group, symbols in zip(moving, motion.symbols.tolist(), strict=True):
            rows = [row for row in range(len(self.means)) if self.group_of[row] == group]
            touched.update(rows)
            centre = mean_of([self.means[row] for row in rows])
            shift, turn = [0.0] * 3, [0.0] * 3
            if motion.predicted:
                past = [self.moved[row] for row in rows if row in self.moved]
                shift, turn = mean_of([was[0] for was in past]), mean_of([was[1] for was in past])
            shift = [a + s * motion.translation_step for a, s in zip(shift, symbols[:3], strict=True)]
            turn = [a + s * motion.rotation_step for a, s in zip(turn, symbols[3:], strict=True)]
            for row in rows:
                self.means[row], self.quats[row] = moved_row(self.means[row], self.quats[row], centre, shift, turn)
        return touched

    def displaced(self, means: list[Row], quats: list[Row], touched: set[int]) -> None:
        """Paragraph "State that is kept": rows were at ``means``, ``quats`` before the frame."""
        self.moved = {}
        for row in sorted(touched):
            shift = [f32(a - b) for a, b in zip(self.means[row], means[row], strict=True)]
            turn = turn_between(quats[row], self.quats[row])
            if any(shift) or any(turn):
                self.moved[row] = (shift, turn)

    def edit(self, source: list[int], means: list[Row], quats: list[Row], sh0: list[Row]) -> None:
        """Last paragraph: rows leave and join. ``source``: for every row, which one it was, from N on an added one.

        The values are those of all rows afterwards.
        """
        number = len(self.means)
        old = [place for place, row in enumerate(source) if row < number]
        if not old:
            self.named, self.group_of, self.count = None, [], 0
        elif self.named is not None:
            before = [max((p for p in old if p <= place), default=old[0]) for place in range(len(source))]
            self.group_of = [self.group_of[source[place]] for place in before]
        self.moved = {place: self.moved[row] for place, row in enumerate(source) if row in self.moved}
        self.means, self.quats, self.sh0 = means, quats, sh0


def mean_of(rows: list[Row]) -> Row:
    """Sum in the order of rows / their number; 0 without any. Not ``sum``: newer Pythons compensate it."""
    total = [0.0, 0.0, 0.0]
    for row in rows:
        total = [a + b for a, b in zip(total, row, strict=True)]
    return [a / len(rows) for a in total] if rows else total


def moved_row(mean: Row, quat: Row, c: Row, shift: Row, turn: Row) -> tuple[Row, Row]:
    """Paragraph "Applied to a row"."""
    x, y, z = turn
    factor = 1 / math.sqrt(1 + x * x + y * y + z * z)
    w, x, y, z = factor, x * factor, y * factor, z * factor
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    d = [mean[i] - c[i] for i in range(3)]
    place = [f32(((R[i][0] * d[0] + R[i][1] * d[1] + R[i][2] * d[2]) + c[i]) + shift[i]) for i in range(3)]
    (w0, x0, y0, z0), (w1, x1, y1, z1) = (w, x, y, z), quat
    product = [
        w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
        w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
        w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
        w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
    ]
    return place, [f32(value) for value in product]


def turn_between(before: Row, after: Row) -> Row:
    """The turn from one raw quaternion to the other, axis * tan(angle / 2), float32."""
    (w0, x0, y0, z0), (w1, x1, y1, z1) = before, after
    w = w1 * w0 + x1 * x0 + y1 * y0 + z1 * z0
    x = x1 * w0 - w1 * x0 - y1 * z0 + z1 * y0
    y = y1 * w0 - w1 * y0 + x1 * z0 - z1 * x0
    z = z1 * w0 - w1 * z0 - x1 * y0 + y1 * x0
    size = (w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0) * (w1 * w1 + x1 * x1 + y1 * y1 + z1 * z1)
    if w == 0 or 4 * (w * w) < size:
        return [0.0, 0.0, 0.0]
    return [f32(x / w), f32(y / w), f32(z / w)]
