"""Motion on epipolar lines over time: what a camera sees move, sorted so that other cameras can be compared with it.

A plane through the centres of two cameras cuts both pictures in a line, and what moves in the plane moves on both. How
much moves on each line in each frame (a "motion barcode", Ben-Artzi et al., CVPR 2016) is therefore alike in both
cameras, at the same instants, whatever their colours and however far apart they are. No feature is matched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.input.prepare.picture_checks import Thumbnails
from gsstream.metrics.noise import noise_sigma

#: Number of epipolar planes per pair of cameras, spread over the angles that both cameras see.
PLANES = 48
#: Changes count above so much and above so many standard deviations of the noise; above the third number, a larger
#: change counts no more than a smaller one.
LEVELS, SIGMAS, LARGE = 8 / 255, 6.0, 0.3
#: Where more of a picture than this changes at once, light or exposure changed: nothing is known of what moved.
MOST = 0.5
#: The range of angles is taken from a grid of so many rays along each axis.
GRID = 24


@dataclass(frozen=True, slots=True)
class Motion:
    """What moves in one camera, M pixels over all steps from a frame to the next."""

    steps: int  # number of steps
    step: IntArray  # [M] in which step
    place: FloatArray  # [M, 2] centre of the pixel
    strength: FloatArray  # [M] change
    pixels: int  # of one picture

    @property
    def share(self) -> float:
        """Mean share of the picture that moves."""
        return len(self.step) / (self.steps * self.pixels)


def motions(thumbs: Thumbnails) -> list[Motion]:
    """Return what moves in each camera."""
    return [_motion(thumbs.images[:, c]) for c in range(len(thumbs.cameras))]


def _motion(images: FloatArray) -> Motion:
    some = range(0, len(images) - 1, max(1, (len(images) - 1) // 5))
    sigma = float(np.median([noise_sigma(images[t], images[t + 1]) for t in some]))
    change = np.abs(np.diff(images, axis=0)).max(-1)
    moves = change > max(LEVELS, SIGMAS * sigma)
    moves &= (moves.mean(axis=(1, 2)) < MOST)[:, None, None]
    step, row, column = np.nonzero(moves)
    strength = np.minimum(change[step, row, column], LARGE)
    return Motion(
        steps=len(change),
        step=step,
        place=np.stack([column, row], axis=1) + 0.5,
        strength=strength,
        pixels=change[0].size,
    )


def barcodes(
    cameras: Cameras, pair: tuple[int, int], seen: tuple[Motion, Motion]
) -> tuple[FloatArray, FloatArray] | None:
    """Return [steps, PLANES] of motion on the lines of two poses; None when they share none.

    ``pair``: the poses, ``seen``: what moves in the pictures that are taken for theirs.
    """
    first, second = (cameras.centers[i] for i in pair)
    gap = float(np.linalg.norm(second - first))
    if gap < 1e-9:
        return None
    base = (second - first) / gap
    across = np.cross(base, np.eye(3)[np.abs(base).argmin()])
    axes = np.stack([across / np.linalg.norm(across), np.cross(base, across / np.linalg.norm(across))])
    x, y = np.meshgrid(np.linspace(0, cameras.width, GRID), np.linspace(0, cameras.height, GRID))
    border = np.stack([x.ravel(), y.ravel()], axis=1)
    all_angles = [_angles(cameras, i, border, axes) for i in pair]
    middle = float(np.angle(sum(np.exp(1j * angles).mean() for angles in all_angles)))
    spans = [np.percentile(_turned(angles, middle), [1, 99]) for angles in all_angles]
    low, high = max(span[0] for span in spans), min(span[1] for span in spans)
    if high - low < 1e-3:
        return None
    codes = []
    for i, motion in zip(pair, seen, strict=True):
        share = (_turned(_angles(cameras, i, motion.place, axes), middle) - low) / (high - low)
        inside = (share >= 0) & (share < 1)
        cell = motion.step[inside] * PLANES + (share[inside] * PLANES).astype(np.int64)
        total = np.bincount(cell, motion.strength[inside], motion.steps * PLANES)
        codes.append(np.sqrt(total.reshape(motion.steps, PLANES)))
    return codes[0], codes[1]


def _angles(cameras: Cameras, i: int, places: FloatArray, axes: FloatArray) -> FloatArray:
    """[M] angle about the baseline of the half plane in which the ray of each pixel lies."""
    rays = np.concatenate([places, np.ones((len(places), 1))], axis=1) @ np.linalg.inv(cameras.Ks[i]).T
    u, v = axes @ (rays @ cameras.viewmats[i, :3, :3]).T
    angles: FloatArray = np.arctan2(v, u)
    return angles


def _turned(angles: FloatArray, middle: float) -> FloatArray:
    turned: FloatArray = (angles - middle + np.pi) % (2 * np.pi) - np.pi
    return turned


def likeness(first: FloatArray, second: FloatArray, reach: int) -> FloatArray:
    """Return [2 reach + 1] correlation of two barcodes, the second -reach to reach steps later; NaN: unknown."""
    found = np.full(2 * reach + 1, np.nan)
    for late in range(-reach, reach + 1):
        a = first[max(0, -late) : len(first) - max(0, late)]
        b = second[max(0, late) : len(second) - max(0, -late)]
        a, b = a - a.mean(0), b - b.mean(0)
        size = float(np.sqrt((a * a).sum() * (b * b).sum()))
        if size > 0:
            found[late + reach] = float((a * b).sum()) / size
    return found
