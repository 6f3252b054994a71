"""Cameras: a calibrated rig of pinhole cameras that share one image size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray, as_array, check_finite, check_shape


@dataclass(frozen=True, slots=True)
class Cameras:
    """C pinhole cameras.

    Arguments:
        ids: C names, unique.
        viewmats: [C, 4, 4] float64 world-to-camera, OpenCV axes (x right, y down, z forward), scene units.
        Ks: [C, 3, 3] float64 intrinsics in pixels, pixel-corner origin (centre of the first pixel is (0.5, 0.5)).
        width, height: image size in pixels, the same for all cameras.
        near_plane: near plane, scene units; nothing closer to a camera is drawn. On a rig that looks inwards it keeps
            Gaussians of one camera's wall out of the face of its neighbours.
    """

    ids: tuple[str, ...]
    viewmats: FloatArray
    Ks: FloatArray
    width: int
    height: int
    near_plane: float = 0.01

    def __post_init__(self) -> None:
        """Take lists, too."""
        object.__setattr__(self, "ids", tuple(self.ids))
        for name in ("viewmats", "Ks"):
            values = getattr(self, name)
            if not isinstance(values, np.ndarray):
                object.__setattr__(self, name, as_array(f"cameras: {name}", values).astype(np.float64))

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def centers(self) -> FloatArray:
        """[C, 3] camera centres in the world."""
        rotation, translation = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        centers: FloatArray = -np.einsum("cji,cj->ci", rotation, translation)
        return centers

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a camera centre to their mean (3DGS convention), scene units."""
        if len(self) == 0:
            return 1.0
        radius = np.linalg.norm(self.centers - self.centers.mean(0), axis=1).max()
        return float(1.1 * radius) if radius > 0 else 1.0

    def select(self, index: Sequence[int]) -> Cameras:
        """Return the part of the rig that has these camera indices, in their order."""
        index = list(index)
        ids = tuple(self.ids[i] for i in index)
        return replace(self, ids=ids, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def joined(self, other: Cameras) -> Cameras:
        """Return one rig of these cameras, then of others of the same image size; the near plane is that of these."""
        return replace(
            self,
            ids=(*self.ids, *other.ids),
            viewmats=np.concatenate([self.viewmats, other.viewmats]),
            Ks=np.concatenate([self.Ks, other.Ks]),
        )

    def scaled(self, width: int, height: int) -> Cameras:
        """Return the same rig at another image size.

        Intrinsics scale with it, exactly, because pixel coordinates count from the corner of the image.
        """
        factor = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, Ks=factor @ self.Ks, width=width, height=height)

    def validate(self) -> None:
        """Raise ShapeError for cameras that are no pinhole rig.

        That is for NaN poses, reflected or scaled rotations, intrinsics that are not invertible or have skew, last rows
        that are not those of a pinhole camera, repeated names.
        """
        c = len(self)
        if not 0 < self.near_plane < np.inf:
            raise ShapeError(f"near plane: expected a positive distance in scene units, got {self.near_plane}")
        check_shape("viewmats", self.viewmats, (c, 4, 4))
        check_shape("Ks", self.Ks, (c, 3, 3))
        if len(set(self.ids)) != c:
            raise ShapeError(f"camera ids must be unique, got {list(self.ids)}")
        for i, name in enumerate(self.ids):
            check_finite(f"pose (w2c) of camera {name!r}", self.viewmats[i])
            check_finite(f"intrinsics (K) of camera {name!r}", self.Ks[i])
            _check_rotation(name, self.viewmats[i, :3, :3])
            if self.Ks[i, 0, 0] <= 0 or self.Ks[i, 1, 1] <= 0 or abs(np.linalg.det(self.Ks[i])) < 1e-12:
                raise ShapeError(
                    f"intrinsics (K) of camera {name!r} are not invertible: expected positive focal lengths in pixels, "
                    f"got fx = {self.Ks[i, 0, 0]:g}, fy = {self.Ks[i, 1, 1]:g}; check the calibration file"
                )
            _check_pinhole(name, self.viewmats[i], self.Ks[i])


def _check_pinhole(name: str, viewmat: FloatArray, K: FloatArray) -> None:
    """Raise ShapeError unless the matrices are those of a pinhole camera without skew: no renderer reads skew."""
    # Calibrations written with rounding carry a skew of a millionth; it moves no pixel by as much.
    if abs(K[0, 1]) > 1e-6 * K[0, 0] or abs(K[1, 0]) > 1e-6 * K[1, 1]:
        raise ShapeError(
            f"intrinsics (K) of camera {name!r}: expected no skew, got K[0, 1] = {K[0, 1]:g}, K[1, 0] = {K[1, 0]:g}; "
            "undistort the images first"
        )
    if not np.allclose(K[2], [0, 0, 1], rtol=0, atol=1e-6):
        raise ShapeError(f"intrinsics (K) of camera {name!r}: expected the last row 0 0 1, got {K[2].tolist()}")
    if not np.allclose(viewmat[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise ShapeError(f"pose (w2c) of camera {name!r}: expected the last row 0 0 0 1, got {viewmat[3].tolist()}")


def _check_rotation(name: str, rotation: FloatArray) -> None:
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > 1e-3 or np.linalg.det(rotation) < 0:
        raise ShapeError(
            f"pose (w2c) of camera {name!r}: the 3x3 part is not a rotation (orthogonality error {error:.2g}, "
            f"determinant {np.linalg.det(rotation):.3g}, expected 1); world-to-camera with OpenCV axes is expected"
        )
