"""A second decoder of fields, written from docs/spec, section 4.5, row by row in plain Python.

Whole numbers are Python's, which never round; everything else is one float operation at a time.
"""

from __future__ import annotations

import itertools
import math
import struct

M32 = 0xFFFFFFFF


def f32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


def mix(v: int) -> int:
    v ^= v >> 16
    v = v * 0x7FEB352D & M32
    v ^= v >> 15
    v = v * 0x846CA68B & M32
    return v ^ v >> 16


def draw(seed: int, n: int, most: int) -> int:
    return (mix((n + mix(seed)) & M32) >> 8) * (2 * most + 1) // 2**24 - most


def cells_of(shape) -> list[int]:
    g, out = 1.0, []
    for _ in range(shape.levels):
        out.append(math.floor(shape.base * g))
        g = g * shape.growth
    return out


def corners(shape, level: int, u: list[float]) -> list[tuple[int, float]]:
    """(entry, weight) of the eight corners of a place's cell."""
    c = cells_of(shape)[level]
    p = [axis * c for axis in u]
    k = [min(math.floor(axis), c - 1) for axis in p]
    f = [a - b for a, b in zip(p, k, strict=True)]
    out = []
    for i in (0, 1):
        for j in (0, 1):
            for m in (0, 1):
                a, b, d = (f[n] if up else 1 - f[n] for n, up in enumerate((i, j, m)))
                x, y, z = k[0] + i, k[1] + j, k[2] + m
                if (c + 1) ** 3 <= 2**shape.entries:
                    entry = (x * (c + 1) + y) * (c + 1) + z
                else:
                    entry = (x ^ 2654435761 * y ^ 805459861 * z) % 2**shape.entries
                out.append((entry, (a * b) * d))
    return out


def places(shape, means: list[list[float]], marks: list[int] | None) -> dict[int, list[float]]:
    """Row -> place in the box, of the rows that move."""
    out = {}
    for row, mean in enumerate(means):
        u = [(x - low) / (high - low) for x, low, high in zip(mean, shape.low, shape.high, strict=True)]
        if (marks is None or marks[row]) and all(0 <= axis <= 1 for axis in u):
            out[row] = u
    return out


def touched(shape, level: int, where: dict[int, list[float]]) -> list[int]:
    return sorted({entry for u in where.values() for entry, _ in corners(shape, level, u)})


def layers(shape) -> list[tuple[int, int]]:
    widths = [shape.levels * shape.features] + [shape.width] * shape.layers + [7]
    return list(itertools.pairwise(widths))


def said(field, u: list[float], tables: list[dict[int, list[int]]]) -> list[float]:
    """The seven numbers that the network says of a place."""
    shape, inputs = field.shape, []
    for level, table in enumerate(tables):
        near = corners(shape, level, u)
        for number in range(shape.features):
            total = near[0][1] * table[near[0][0]][number]
            for entry, weight in near[1:]:
                total = total + weight * table[entry][number]
            inputs.append(math.floor(total + 0.5))
    first = 2**31
    for index, (inner, outer) in enumerate(layers(shape)):
        most = math.floor(2**14 * math.sqrt(6 / inner)) if index < shape.layers else 0
        symbols = field.weights[index]
        sums = []
        for out in range(outer):
            weights = [
                draw(field.shape.seed, first + n * outer + out, most) + int(symbols[n, out]) * field.weight_step
                for n in range(inner)
            ]
            sums.append(sum(a * b for a, b in zip(inputs, weights, strict=True)))
        first += inner * outer
        # floor(z 2^-14 + 0.5) of a whole number z
        inputs = [min(max((z + 2**13) >> 14, 0), 2**26 - 1) for z in sums]
    return [z / 2**34 for z in sums]


def apply(field, means: list[list[float]], quats: list[list[float]]) -> tuple[list[list[float]], list[list[float]]]:
    """Centres and quaternions after a field."""
    shape = field.shape
    where = places(shape, means, None if field.marks is None else field.marks.tolist())
    tables = []
    for level in range(shape.levels):
        table = {}
        for rank, entry in enumerate(touched(shape, level, where)):
            n = (level * 2**shape.entries + entry) * shape.features
            table[entry] = [
                draw(shape.seed, n + i, 105) + int(field.entries[level][rank, i]) * field.entry_step
                for i in range(shape.features)
            ]
        tables.append(table)
    means, quats = [list(row) for row in means], [list(row) for row in quats]
    for row, u in where.items():
        v = said(field, u, tables)
        means[row] = [f32(x + shift * shape.reach) for x, shift in zip(means[row], v[:3], strict=True)]
        w = max(1 + v[3], 0.1)
        x, y, z = (part / w for part in v[4:])
        s = 1 / math.sqrt(1 + x * x + y * y + z * z)
        w0, x0, y0, z0 = s, x * s, y * s, z * s
        w1, x1, y1, z1 = quats[row]
        quats[row] = [
            f32(value)
            for value in (
                w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
                w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
                w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
                w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
            )
        ]
    return means, quats
