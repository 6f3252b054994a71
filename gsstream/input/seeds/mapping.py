"""Poses, lenses and points of one instant by structure from motion, in its own process. Needs ``gsstream[sfm]``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.install_hints import page
from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import BoolArray, FloatArray, IntArray, check_finite, check_shape
from gsstream.input.recordings.lens import Lens, from_colmap
from gsstream.input.seeds.sfm import run_pycolmap, write_images, write_rig

#: Lens models by COLMAP's names.
LENSES = ("PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")


@dataclass(frozen=True, slots=True)
class Mapping:
    """What structure from motion found.

    Arguments:
        viewmats: [C, 4, 4]; NaN where a camera was not registered.
        Ks, lenses: [C, 3, 3] and C lenses, for pixels of each camera's own picture.
        xyz, rgb, error, track: P points, their colours (uint8), reprojection errors (pixels) and numbers of views.
        camera_error: [C] mean reprojection error, pixels; NaN where nothing is known.
        camera_points: [C] points that each camera sees.
    """

    viewmats: FloatArray
    Ks: FloatArray
    lenses: tuple[Lens, ...]
    xyz: FloatArray
    rgb: IntArray
    error: FloatArray
    track: IntArray
    camera_error: FloatArray
    camera_points: IntArray

    @property
    def registered(self) -> BoolArray:
        """[C] bool."""
        return np.asarray(np.isfinite(self.viewmats).all(axis=(1, 2)))


def reconstruct(
    images: Sequence[FloatArray] | FloatArray,
    *,
    model: str = "SIMPLE_RADIAL",
    shared: bool = True,
    held: Sequence[int] = (),
    names: Sequence[str] = (),
    timeout: float = 1800.0,
    tell: Tell = silent,
) -> Mapping:
    """Map C images [H, W, 3] in [0, 1] of one instant; of different sizes, unless they share a lens.

    ``names``: names of the cameras, for messages. The same input gives the same result. Raises InputError when pycolmap
    is missing, and, with the matches of each pair, when it finds nothing to begin with.
    """
    if model not in LENSES:
        raise InputError(f"lens model: expected one of {', '.join(LENSES)}, got {model!r}")
    with tempfile.TemporaryDirectory(prefix="gsstream-sfm-") as name:
        folder = Path(name)
        write_images(folder, images)
        np.savez(folder / "job.npz", model=model, shared=shared, held=np.array(held, np.int64))
        run_pycolmap("reconstruct", folder, timeout, tell)
        if (folder / "apart.npz").exists():
            with np.load(folder / "apart.npz") as result:
                raise InputError(_apart(result["pairs"], result["counts"], names))
        with np.load(folder / "points.npz") as result:
            found = dict(result)
    Ks, lenses = zip(*(from_colmap(model, params, "structure from motion") for params in found["cameras"]), strict=True)
    return _mapping(found, found["viewmats"], np.stack(Ks), lenses)


def _apart(pairs: IntArray, counts: IntArray, names: Sequence[str]) -> str:
    most = np.argsort(-counts, kind="stable")[:10]
    listed = ", ".join(" and ".join(names[i] if names else str(i) for i in pairs[k]) + f" {counts[k]}" for k in most)
    more = f", and {len(counts) - len(most)} pairs with no more" if len(counts) > len(most) else ""
    return (
        f"structure from motion: no two pictures share enough features to begin with (matches: {listed}{more}); give "
        "poses instead: calibrate the cameras with a board and put the calibration beside the pictures "
        f"({page('howto/prepare.md')})"
    )


def triangulate(images: FloatArray, cameras: Cameras, *, timeout: float = 1800.0, tell: Tell = silent) -> Mapping:
    """Triangulate points of [C, H, W, 3] images in [0, 1] with known poses and pinhole lenses.

    Each point comes with the pixel at which every camera saw it.
    """
    with tempfile.TemporaryDirectory(prefix="gsstream-sfm-") as name:
        folder = Path(name)
        write_images(folder, images)
        write_rig(folder, cameras)
        run_pycolmap("triangulate", folder, timeout, tell)
        with np.load(folder / "points.npz") as result:
            found = dict(result)
    return _mapping(found, cameras.viewmats, cameras.Ks, (Lens("radial", ()),) * len(cameras))


def triangulate_points(
    images: FloatArray, cameras: Cameras, *, max_error: float = 2.0, timeout: float = 900.0, tell: Tell = silent
) -> PointCloud:
    """Match SIFT features between all pairs of training images and triangulate them with the given poses.

    Returns points in scene units with the mean colour of their features. The same input gives the same points.
    Raises InputError when pycolmap is not installed, when the process fails, and when nothing could be triangulated.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    check_finite("images", images)
    found = triangulate(images, cameras, timeout=timeout, tell=tell)
    keep = np.isfinite(found.xyz).all(1) & (found.error <= max_error)
    if not keep.any():
        raise InputError(
            f"structure from motion found no points in {len(cameras)} training images of {cameras.width} x "
            f"{cameras.height}: check the poses (world-to-camera, OpenCV axes), or use larger images"
        )
    colors = found.rgb[keep].astype(np.float32) / np.float32(255)
    return PointCloud(found.xyz[keep].astype(np.float32), colors, f"triangulated from {len(cameras)} training images")


def _mapping(found: dict[str, Any], viewmats: FloatArray, Ks: FloatArray, lenses: tuple[Lens, ...]) -> Mapping:
    count = len(lenses)
    seen = np.bincount(found["seen_image"], minlength=count)
    total = np.bincount(found["seen_image"], weights=found["seen_error"], minlength=count)
    error = np.divide(total, seen, out=np.full(count, np.nan), where=seen > 0)
    if "held_error" in found:
        error = np.where(seen > 0, error, found["held_error"])
    return Mapping(
        viewmats=viewmats,
        Ks=Ks,
        lenses=lenses,
        xyz=found["xyz"],
        rgb=found["rgb"],
        error=found["error"],
        track=found["track"],
        camera_error=error,
        camera_points=seen,
    )
