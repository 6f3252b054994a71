"""Fixed-point grids of key packets: which values survive, and as which integers they are coded.

Every grid is a power of two, so decoded values are exact in float32 and quantising twice equals quantising once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.shapes import FloatArray, IntArray

#: Fractional bits of each attribute (raw units); of colours: of their luma, chroma has one bit less. Chosen on real
#: scenes so that all together lose a few hundredths of a dB.
KEY_BITS: Mapping[str, int] = {"quats": 7, "scales": 4, "opacities": 3, "sh0": 6, "shN": 7}
#: Largest magnitude of a code. Sums of three codes of the colour transform stay exact in float32.
MAX_CODE = 1 << 20
MAX_BITS = 20
_COLORS = ("sh0", "shN")


def to_codes(name: str, values: FloatArray, bits: int) -> IntArray:
    """Return the [N, width] int32 codes of an attribute.

    Raises ShapeError for values out of range or quaternions of norm zero.
    """
    flat = np.asarray(values, np.float64).reshape(len(values), math.prod(values.shape[1:]))
    if name == "quats":
        scaled = _unit(flat, bits)
    elif name in _COLORS:
        scaled = np.rint(color_codes(flat, bits))
    else:
        scaled = np.rint(flat * 2.0**bits)
    if scaled.size and float(np.abs(scaled).max()) >= MAX_CODE:
        raise ShapeError(
            f"{name}: expected values within +-{MAX_CODE / 2.0 ** (bits + 2):g}, got {np.abs(flat).max():g}; "
            "the optimisation has diverged"
        )
    return scaled.astype(np.int32)


def from_codes(name: str, codes: IntArray, bits: int) -> FloatArray:
    """Return the [N, width] float32 values of codes."""
    if name in _COLORS:
        return _from_luma(codes / _color_scale(bits, codes.shape[1])).astype(np.float32)
    return codes.astype(np.float32) * np.float32(2.0**-bits)


def color_codes(values: FloatArray, bits: int) -> FloatArray:
    """Return the codes [N, width] float64 of colours before they are rounded."""
    flat = np.asarray(values, np.float64).reshape(len(values), math.prod(values.shape[1:]))
    return np.asarray(_to_luma(flat) * _color_scale(bits, flat.shape[1]))


def color_grads(gradients: FloatArray, bits: int) -> FloatArray:
    """Return the derivative [N, width] float64 by the codes of colours, from that by the colours themselves."""
    flat = np.asarray(gradients, np.float64).reshape(len(gradients), math.prod(gradients.shape[1:]))
    # A row for each of luma and the two chromas: the colour that one of it makes.
    colors = _from_luma(np.eye(3))
    by_code = (flat.reshape(len(flat), -1, 3) @ colors.T).reshape(flat.shape)
    return np.asarray(by_code / _color_scale(bits, flat.shape[1]))


def fold_quats(codes: IntArray, bits: int) -> IntArray:
    """Return [N, 5] symbols of quaternions.

    They say which component is largest, the three others, and what the unit norm does not say about it.
    """
    rows, largest = np.arange(len(codes)), np.abs(codes).argmax(1)
    others = codes[rows[:, None], _OTHERS[largest]]
    rest = codes[rows, largest] - _implied(others, bits)
    return np.column_stack([largest, others, rest]).astype(np.int32)


def unfold_quats(symbols: IntArray, bits: int) -> IntArray:
    """Return the codes of which :func:`fold_quats` made these symbols.

    Raises PacketError for symbols that no encoder writes.
    """
    largest, others = symbols[:, 0], symbols[:, 1:4]
    if largest.size and not 0 <= int(largest.min()) <= int(largest.max()) <= 3:
        raise PacketError("quats: the index of the largest component is outside 0 to 3")
    if others.size and int(np.abs(others.astype(np.int64)).max()) >= MAX_CODE:
        raise PacketError("quats: code out of range")
    value = symbols[:, 4].astype(np.int64) + _implied(others, bits)
    if value.size and not (np.all(value >= np.abs(others).max(1)) and value.min() > 0 and value.max() < MAX_CODE):
        raise PacketError("quats: the largest component is not the largest, or out of range")
    out = np.empty((len(symbols), 4), np.int32)
    rows = np.arange(len(symbols))
    out[rows[:, None], _OTHERS[largest]] = others
    out[rows, largest] = value
    return out


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def _implied(others: IntArray, bits: int) -> IntArray:
    """[N] int64 code that gives norm one; integers below 2^53 under an exactly rounded root: equal on all machines."""
    rest = 4**bits - (others.astype(np.int64) ** 2).sum(1)
    return np.asarray(np.rint(np.sqrt(np.maximum(rest, 0))), np.int64)


def _unit(values: FloatArray, bits: int) -> FloatArray:
    scaled = np.rint(values * 2.0**bits)
    # Decided on the rounded codes: rounding moves a norm by at most 2^-bits, so doing it again changes nothing.
    stray = np.abs(np.linalg.norm(scaled, axis=1) / 2.0**bits - 1) > 1.25 * 2.0**-bits
    norm = np.linalg.norm(values[stray], axis=1, keepdims=True)
    if norm.size and float(norm.min()) < 1e-30:
        row = int(np.flatnonzero(stray)[int(norm.argmin())])
        raise ShapeError(f"quats: row {row} has norm zero, which is no rotation")
    scaled[stray] = np.rint(values[stray] / norm * 2.0**bits)
    # q and -q are one rotation: the largest component is positive.
    largest = scaled[np.arange(len(scaled)), np.abs(scaled).argmax(1)]
    return np.asarray(scaled * np.where(largest < 0, -1.0, 1.0)[:, None] + 0.0)


def _color_scale(bits: int, width: int) -> FloatArray:
    return np.tile([2.0**bits, 2.0 ** (bits - 1), 2.0 ** (bits - 1)], width // 3)


def _to_luma(rgb: FloatArray) -> FloatArray:
    """YCoCg of every three channels (lifting form: sums of exact halves)."""
    red, green, blue = rgb[:, 0::3], rgb[:, 1::3], rgb[:, 2::3]
    orange = red - blue
    middle = blue + orange / 2
    out = np.empty_like(rgb)
    out[:, 0::3], out[:, 1::3], out[:, 2::3] = middle + (green - middle) / 2, orange, green - middle
    return out


def _from_luma(ycc: FloatArray) -> FloatArray:
    luma, orange, green = ycc[:, 0::3], ycc[:, 1::3], ycc[:, 2::3]
    middle = luma - green / 2
    blue = middle - orange / 2
    out = np.empty_like(ycc)
    out[:, 0::3], out[:, 1::3], out[:, 2::3] = blue + orange, green + middle, blue
    return out
