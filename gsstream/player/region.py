"""The region that a rig has recorded: how far a viewer may turn, tilt and go before he sees what no camera saw.

The page has the same rule (gsstream/web/region.js), and tests/web/test_region.py compares their limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point, looks_one_way, point_ahead
from gsstream.core.shapes import FloatArray
from gsstream.core.world import up_direction

#: Cameras around the scene whose neighbours are nowhere farther apart than this surround it, radians.
OPEN_GAP = np.pi / 2
#: Half of the smallest range of an angle, radians: a single camera, or a few side by side, still show some parallax.
MIN_SWING = np.pi / 18
#: How far beyond a limit a picture fades out: an angle in radians, and a factor of the distance.
SLACK, SLACK_FACTOR = np.pi / 18, 1.3
#: Limits of the distance, as factors of that of the nearest and of the farthest camera: at the first, pixels of the
#: recording are twice as large; beyond the second there is little more to see.
NEAREST, FARTHEST = 0.5, 1.5
#: Nearer than this to straight up or down (cosine) an azimuth says nothing.
STEEP = float(np.cos(np.pi / 18))
#: Where angles are cut for sorting, radians, and how much wider a gap must be: a tie is not decided by rounding.
_CUT, _TIE = 1.0, 1e-9


@dataclass(frozen=True, slots=True)
class Region:
    """Limits of viewpoints around a point."""

    focus: FloatArray  # [3] the point around which a viewer turns
    up: FloatArray  # [3] unit vector
    #: Whether cameras look away from the focus; then angles are those of where they look, else those of where they
    #: stand.
    outward: bool
    #: The middle of the range and half of its width, radians (:meth:`angles`); None: all around.
    azimuth: tuple[float, float] | None
    elevation: tuple[float, float]  # lowest and highest, radians
    distance: tuple[float, float]  # smallest and largest from the focus, scene units

    def arms(self, rig: Cameras) -> FloatArray:
        """[C, 3] unit vectors of which the angles are checked."""
        arms = rig.viewmats[:, 2, :3] if self.outward else rig.centers - self.focus
        norms: FloatArray = np.linalg.norm(arms, axis=1, keepdims=True)
        return np.where(norms > 0, arms / np.where(norms > 0, norms, 1.0), -rig.viewmats[:, 2, :3])

    def angles(self, arms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """[C] azimuths and [C] elevations, radians; azimuth 0 is nearest to x, or to y where x is almost up."""
        first, second = level_axes(self.up)
        return np.arctan2(arms @ second, arms @ first), np.arcsin(np.clip(arms @ self.up, -1, 1))

    def outside(self, rig: Cameras) -> FloatArray:
        """[C] how far cameras are outside: 0 within the region, 1 where nothing of the picture is left."""
        arms = self.arms(rig)
        azimuth, elevation = self.angles(arms)
        low, high = self.elevation
        beyond = np.maximum(low - elevation, elevation - high) / SLACK
        if self.azimuth is not None:
            middle, half = self.azimuth
            turned = np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi) - half
            beyond = np.where(np.abs(arms @ self.up) < STEEP, np.maximum(beyond, turned / SLACK), beyond)
        near, far = self.distance
        distance = np.linalg.norm(rig.centers - self.focus, axis=1)
        factor = np.maximum(distance / far, near / np.maximum(distance, 1e-300)) if far > 0 else np.ones(len(rig))
        outside: FloatArray = np.clip(np.maximum(beyond, np.log(factor) / np.log(SLACK_FACTOR)), 0, 1)
        return outside


def recorded_region(rig: Cameras) -> Region:
    """Return the region of a rig of at least one camera. No camera of the rig is outside."""
    focus, outward = _focus(rig)
    up = up_direction(rig)
    region = Region(focus=focus, up=up, outward=outward, azimuth=None, elevation=(0.0, 0.0), distance=(0.0, 0.0))
    arms = region.arms(rig)
    azimuth, elevation = region.angles(arms)
    level = np.abs(arms @ up) < STEEP
    distance = np.linalg.norm(rig.centers - focus, axis=1)
    middle, half = (elevation.max() + elevation.min()) / 2, max((elevation.max() - elevation.min()) / 2, MIN_SWING)
    return Region(
        focus=focus,
        up=up,
        outward=outward,
        azimuth=_arc(azimuth[level]) if level.any() else None,
        elevation=(float(middle - half), float(middle + half)),
        distance=(float(NEAREST * distance.min()), float(FARTHEST * distance.max())),
    )


def level_axes(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors [3] across ``up``: azimuths 0 and 90 degrees."""
    axis = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0, 1.0, 0])
    first = axis - (axis @ up) * up
    first = first / np.linalg.norm(first)
    return first, np.cross(up, first)


def _focus(rig: Cameras) -> tuple[FloatArray, bool]:
    """The point around which a viewer turns, and whether the cameras look away from the point."""
    focus = focus_point(rig)
    outward = float(np.einsum("ci,ci->", rig.centers - focus, rig.viewmats[:, 2, :3])) >= -1e-9 * len(rig)
    # Cameras that look apart, but on the whole one way, are taken as parallel.
    return (point_ahead(rig), False) if outward and looks_one_way(rig) else (focus, outward)


def _arc(azimuth: FloatArray) -> tuple[float, float] | None:
    """Return middle and half of the range outside the widest gap between neighbours; None: there is no wide gap."""
    places = np.sort((azimuth - _CUT) % (2 * np.pi))
    gaps = np.diff(places, append=places[0] + 2 * np.pi)
    if gaps.max() <= OPEN_GAP + _TIE:
        return None
    widest = int(np.flatnonzero(gaps >= gaps.max() - _TIE)[0])
    half = (2 * np.pi - gaps[widest]) / 2
    middle = places[(widest + 1) % len(places)] + half + _CUT
    return float((middle + np.pi) % (2 * np.pi) - np.pi), float(max(half, MIN_SWING))
