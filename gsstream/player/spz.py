"""SPZ files, version 3: one scene in the compressed format of nianticlabs/spz (MIT), which viewers of splats read.

A header of 16 bytes and one block of bytes per attribute, gzipped. The format's axes are right, up, back, where those
of a PLY are right, down, front: programs that read both take them so.
"""

from __future__ import annotations

import gzip
import struct

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.harmonics import rotate_sh
from gsstream.core.shapes import FloatArray, IntArray

MAGIC, VERSION = 0x5053474E, 3
#: Higher coefficients of spherical harmonics -> degree.
DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}
#: Bits after the point that positions have at most: with more, readers that compute ``1 << bits`` overflow.
MOST_BITS = 30
#: Logarithm of the largest scale that the format holds, and of the smallest, to which thinner ones are raised.
LARGEST, SMALLEST = 255 / 16 - 10, -10.0
#: From the axes of a PLY to those of the format.
TURN = np.diag([1.0, -1.0, -1.0])
#: Steps, of 256, to which the library of the format rounds coefficients of degree 1, and of higher degrees.
STEPS = (8, 16)


def spz_bytes(gaussians: Gaussians[FloatArray]) -> bytes:
    """Return an SPZ of raw (pre-activation) values in the axes of a PLY; the same bytes for the same scene.

    Positions are rounded to 24 bits of the largest, the rest to 8 bits (quaternions: 10), colours and coefficients of
    degree 1 and more are cut at what the format holds (-3.3 to 3.3, and -1 to 1).

    Raises InputError for scales of more than e^5.9 units, which the format cannot hold, and for degrees above 3.
    """
    number, rest = len(gaussians), gaussians.shN.shape[1]
    if rest not in DEGREES:
        raise InputError(f"SPZ: expected 0, 3, 8 or 15 higher coefficients, got {rest}; export ply")
    large = int((gaussians.scales > LARGEST + 1 / 32).any(1).sum())
    if large:
        raise InputError(
            f"SPZ holds scales up to {np.exp(LARGEST):.0f} units, and {large} of {number} Gaussians are larger: export "
            "ply, or give the recording in a larger unit"
        )
    means = gaussians.means @ TURN
    bits = _bits(means)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, number, DEGREES[rest], bits, 0, 0)
    positions = np.rint(np.ldexp(means, bits)).astype("<i4")
    blocks = [
        positions.reshape(-1, 1).view(np.uint8)[:, :3],
        _byte(127.5 * (1 + np.tanh(gaussians.opacities / 2))),  # 255 times the sigmoid, which overflows nowhere
        _byte(255 * (0.15 * gaussians.sh0 + 0.5)),
        _byte(16 * (np.maximum(gaussians.scales, SMALLEST) + 10)),
        _rotations(gaussians.quats * [1, *np.diag(TURN)]).view(np.uint8),
        _coefficients(rotate_sh(gaussians.shN, TURN)),
    ]
    return gzip.compress(header + b"".join(np.ascontiguousarray(block).tobytes() for block in blocks), mtime=0)


def _bits(means: FloatArray) -> int:
    """How many of the 24 bits of a position may stand after the point."""
    largest = float(np.abs(means).max()) if len(means) else 0.0
    bits = MOST_BITS if largest == 0 else int(np.floor(np.log2((2**23 - 1) / largest)))
    if bits < 0:
        raise InputError(f"SPZ holds positions up to {2**23 - 1}, got {largest:g}: write them by --origin local")
    return min(bits, MOST_BITS)


def _byte(values: FloatArray) -> IntArray:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def _rotations(quats: FloatArray) -> IntArray:
    """[N] uint32: the number of the largest of x, y, z, w; then of the three others sign and 9 bits of size."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw = xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(1)
    rows = np.arange(len(xyzw))
    xyzw = xyzw * np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype("<u4")
    sizes = np.rint(np.abs(xyzw) * np.sqrt(2) * 511).astype("<u4")
    for axis in range(4):
        with_axis = packed << 10 | np.where(xyzw[:, axis] < 0, 512, 0).astype("<u4") | sizes[:, axis]
        packed = np.where(largest == axis, packed, with_axis).astype("<u4")
    return np.asarray(packed)


def _coefficients(shN: FloatArray) -> IntArray:
    """[N, K - 1, 3] uint8, colours fastest."""
    steps = np.where(np.arange(shN.shape[1]) < 3, *STEPS)[None, :, None]
    values = np.rint(128 * shN.astype(np.float64)) + 128
    return _byte((values + steps // 2) // steps * steps)
