"""World: where the coordinates of a stream lie in those of its recording, and which ones a stream is given.

A similarity, ``x_recording = scale * rotation @ x_stream + offset`` in float64. Recordings come in any unit, turned and
moved at will; float32 arithmetic, an octree along the axes and absolute thresholds are not indifferent to that. So a
recording is opened in a frame that its own cameras define (:func:`rig_similarity`), and whatever people read or write
is taken back to the recording's coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import quat_multiply
from gsstream.core.errors import ShapeError
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.harmonics import rotate_sh
from gsstream.core.shapes import FloatArray

#: Cameras in a stream's own coordinates are rounded to this: far below the accuracy of a calibration, far above the
#: noise of float64, so that a recording in another world mostly gives the very same numbers.
GRID = 2.0**-30
#: Camera centres that differ by less than this share of their distance to the origin are one place, up to rounding.
COINCIDENT = 1e-12
#: A mean of unit vectors shorter than this says nothing about a direction.
MIN_MEAN = 0.1


@dataclass(frozen=True, slots=True)
class World:
    """A similarity from the coordinates of a stream to those of its recording.

    Arguments:
        rotation: nine numbers, row by row: the stream's axes in the recording's, as columns.
        offset: the stream's origin in the recording, recording units.
        scale: recording units per stream unit.
    """

    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    @property
    def matrix(self) -> FloatArray:
        """[3, 3] the rotation."""
        return np.array(self.rotation, np.float64).reshape(3, 3)

    @property
    def is_identity(self) -> bool:
        """Whether stream and recording share their coordinates."""
        return self == IDENTITY

    def is_near(self, other: World) -> bool:
        """Say whether two worlds put everything within a rig's extent at the same place, up to rounding."""
        if abs(self.scale - other.scale) > 1e-6 * self.scale:
            return False
        apart = np.abs(self.points(np.eye(3)) - other.points(np.eye(3))).max()
        return bool(apart <= 1e-6 * self.scale + 1e-12 * np.abs(self.offset).max())

    def validate(self) -> None:
        """Raise ShapeError unless this is a similarity of finite numbers."""
        if len(self.rotation) != 9 or len(self.offset) != 3:
            raise ShapeError(f"world: expected 9 and 3 numbers, got {len(self.rotation)} and {len(self.offset)}")
        if not np.isfinite([*self.rotation, *self.offset, self.scale]).all() or self.scale <= 0:
            raise ShapeError(f"world: expected finite numbers and a scale above 0, got {self}")
        error = float(np.abs(self.matrix @ self.matrix.T - np.eye(3)).max())
        if error > 1e-6 or np.linalg.det(self.matrix) < 0:
            raise ShapeError(f"world: expected a rotation, got one that is not orthogonal by {error:.2g}, or a mirror")

    def inverse(self) -> World:
        """Return the similarity the other way."""
        rotated = self.matrix.T
        return _world(rotated, -rotated @ np.array(self.offset) / self.scale, 1 / self.scale)

    def after(self, first: World) -> World:
        """Return the similarity that does ``first``, then this one."""
        offset = self.scale * self.matrix @ np.array(first.offset) + np.array(self.offset)
        return _world(self.matrix @ first.matrix, offset, self.scale * first.scale)

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points [N, 3] of the stream in the recording's coordinates, float64."""
        return np.asarray(self.scale * (np.asarray(xyz, np.float64) @ self.matrix.T) + np.array(self.offset))

    def inverse_points(self, xyz: FloatArray) -> FloatArray:
        """Return points [N, 3] of the recording in the stream's coordinates, float64."""
        return np.asarray((np.asarray(xyz, np.float64) - np.array(self.offset)) @ self.matrix / self.scale)

    def cameras(self, rig: Cameras) -> Cameras:
        """Return cameras of the stream in the recording's coordinates: the same pictures of the same scene."""
        viewmats = rig.viewmats.copy()
        viewmats[:, :3, :3] = rig.viewmats[:, :3, :3] @ self.matrix.T
        viewmats[:, :3, 3] = self.scale * rig.viewmats[:, :3, 3] - viewmats[:, :3, :3] @ np.array(self.offset)
        return replace(rig, viewmats=viewmats, near_plane=self.scale * rig.near_plane)

    def inverse_cameras(self, rig: Cameras) -> Cameras:
        """Return cameras of the recording in the stream's coordinates."""
        viewmats = rig.viewmats.copy()
        viewmats[:, :3, :3] = rig.viewmats[:, :3, :3] @ self.matrix
        # Not by the cameras' centres: a rotation that is rounded to six digits would move them by metres in UTM.
        moved = rig.viewmats[:, :3, :3] @ np.array(self.offset) + rig.viewmats[:, :3, 3]
        viewmats[:, :3, 3] = moved / self.scale
        return replace(rig, viewmats=viewmats, near_plane=rig.near_plane / self.scale)

    def gaussians(self, scene: Gaussians[FloatArray]) -> Gaussians[FloatArray]:
        """Return Gaussians of the stream in the recording's coordinates, float64; view-dependent colours turn, too."""
        if self.is_identity:
            return scene
        return Gaussians(
            means=self.points(scene.means),
            quats=quat_multiply(_quaternion(self.matrix)[None], np.asarray(scene.quats, np.float64)),
            scales=np.asarray(scene.scales, np.float64) + np.log(self.scale),
            opacities=scene.opacities,
            sh0=scene.sh0,
            shN=rotate_sh(scene.shN, self.matrix),
        )


IDENTITY = World()


def rig_similarity(rig: Cameras, points: Callable[[], PointCloud | None] = lambda: None) -> World:
    """Return the world that a rig defines for itself: the same, up to rounding, however the rig is moved or rotated.

    Its origin is the mean of the camera centres. One unit is the rig's extent; cameras that all stand in one place have
    none, then it is their median distance to ``points``, then the recording's own unit. The z axis points up
    (:func:`up_direction`), x where the cameras look on average, y to the left. Cameras that look all around have no
    such direction; then x is that of the first one by name that does not look straight up or down.

    Arguments:
        rig: all cameras of the recording, in the recording's coordinates; their order does not matter.
        points: gives those of the recording, in its coordinates; called only where the cameras have no extent.
    """
    rig = rig.select(sorted(range(len(rig)), key=lambda i: rig.ids[i]))
    if len(rig) == 0:
        return IDENTITY
    # Solved rather than by the transpose: rotations of calibration files are rounded.
    centers = -np.linalg.solve(rig.viewmats[:, :3, :3], rig.viewmats[:, :3, 3, None])[..., 0]
    offset = centers.mean(0)
    rotation = _axes(rig)
    radius = float(np.linalg.norm(centers - offset, axis=1).max())
    if radius > COINCIDENT * float(np.abs(centers).max()):
        return _world(rotation, offset, 1.1 * radius)  # as Cameras.extent
    cloud = points()
    if cloud is None or len(cloud) == 0:
        return _world(rotation, offset, 1.0)
    distance = float(np.median(np.linalg.norm(np.asarray(cloud.xyz, np.float64) - offset, axis=1)))
    return _world(rotation, offset, distance if distance > 0 else 1.0)


def snap_cameras(rig: Cameras) -> Cameras:
    """Return cameras whose poses are rounded to ``GRID``; rotations stay rotations."""
    viewmats = np.rint(rig.viewmats / GRID) * GRID + 0.0
    rotations = viewmats[:, :3, :3]
    error = np.einsum("cji,cjk->cik", rotations, rotations) - np.eye(3)
    # One Newton step to the nearest rotation: taken back to coordinates far from the origin, a rounding of 1e-9 would
    # move centres. Rotations that the calibration itself has rounded more coarsely stay as they are.
    step = np.where(np.abs(error).max((1, 2), keepdims=True) < 1e-8, 0.5 * error, 0.0)
    viewmats[:, :3, :3] = rotations - np.einsum("cij,cjk->cik", rotations, step)
    return replace(rig, viewmats=viewmats)


def up_direction(rig: Cameras) -> FloatArray:
    """Return the unit up direction [3] of a rig: across the cameras' x axes, which are level unless one is rolled.

    The mean of the cameras' own up directions would lean towards the side from which a half-circle rig looks down; it
    only gives the sign, and the direction where all x axes are parallel.
    """
    mean = -rig.viewmats[:, 1, :3].mean(0)
    if np.linalg.norm(mean) < 1e-3:
        # The "up" directions of cameras that are rolled against each other cancel out; then that of the first one is
        # taken.
        mean = -rig.viewmats[0, 1, :3]
    axes = rig.viewmats[:, 0, :3]
    values, vectors = np.linalg.eigh(axes.T @ axes / len(rig))
    up = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    level = values[0] < 0.05 * values[1] and values[1] > 1e-3 and up @ mean > 0.5 * np.linalg.norm(mean)
    return np.asarray(up if level else mean / np.linalg.norm(mean))


def _axes(rig: Cameras) -> FloatArray:
    """[3, 3] columns: forward, left, up."""
    up = up_direction(rig)
    forward = rig.viewmats[:, 2, :3]
    level = forward - np.outer(forward @ up, up)
    ahead = level.mean(0)
    if np.linalg.norm(ahead) < MIN_MEAN:
        clear = np.flatnonzero(np.linalg.norm(level, axis=1) >= MIN_MEAN)
        # Cameras that all look along "up" show another direction by their x axes.
        ahead = level[clear[0]] if len(clear) else np.cross(up, rig.viewmats[0, 0, :3])
    x = ahead - (ahead @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up], 1)


def _world(rotation: FloatArray, offset: FloatArray, scale: float) -> World:
    return World(tuple(rotation.reshape(-1).tolist()), tuple(offset.tolist()), float(scale))


def _quaternion(rotation: FloatArray) -> FloatArray:
    """[4] wxyz of a rotation, by the largest of its four components (Shepperd)."""
    r = rotation
    squares = np.array(
        [
            1 + r[0, 0] + r[1, 1] + r[2, 2],
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    a, b, c = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    d, e, f = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    rows = ((squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3]))
    chosen = np.array(rows[int(squares.argmax())], np.float64)
    return np.asarray(chosen / np.linalg.norm(chosen))
