"""Depth maps of frame 0 that a recording of any layout may have: ``depth_frame0/CAMERA.npy`` in its folder.

From a depth camera, a lidar, or a network whose depth was brought to the scale of the poses; for some cameras or all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray

FOLDER = "depth_frame0"
#: Maps may be of another size than the pictures, but not of another shape: ratios of their sides agree so well.
SAME_SHAPE = 0.01


def read_depth_maps(folder: Path | None, cameras: Cameras, unit: float = 1.0) -> FloatArray | None:
    """Return the maps of a folder ``depth_frame0`` at the size of the cameras: [C, H, W] planar depth, NaN: unknown.

    A file is [h, w] in units of the files' poses, of which the cameras' unit has ``unit``; 0, NaN or infinite where
    nothing is known. None where no camera has a map. Raises SourceError for a file that cannot be read or does not fit.
    """
    if folder is None:
        return None
    depths = np.full((len(cameras), cameras.height, cameras.width), np.nan, np.float32)
    for row, name in enumerate(cameras.ids):
        if (path := folder / f"{name}.npy").is_file():
            depths[row] = _read(path, (cameras.height, cameras.width)) / unit
    return depths if np.isfinite(depths).any() else None


def _read(path: Path, shape: tuple[int, int]) -> FloatArray:
    """[H, W] at the size of the pictures, the nearest value of the file for each pixel; NaN where nothing is known."""
    try:
        stored = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise SourceError(f"{path}: cannot be read as a numpy array: {error}; write it with numpy.save") from error
    if not isinstance(stored, np.ndarray) or stored.ndim != 2 or stored.dtype.kind not in "fiu":
        got = f"{list(stored.shape)} {stored.dtype}" if isinstance(stored, np.ndarray) else "an archive"
        raise SourceError(f"{path}: expected planar depth [h, w] as numbers, got {got}")
    (height, width), (rows, columns) = shape, stored.shape
    if min(rows, columns) < 1 or abs(columns * height / (rows * width) - 1) > SAME_SHAPE:
        raise SourceError(
            f"{path}: expected the shape of the camera's pictures, {width} x {height} or another size of it, "
            f"got {columns} x {rows}; export it for the same pictures"
        )
    row = ((np.arange(height) + 0.5) * rows / height).astype(int)
    column = ((np.arange(width) + 0.5) * columns / width).astype(int)
    with np.errstate(over="ignore"):  # what does not fit into float32 becomes infinite, and is not known
        depth: FloatArray = stored[row][:, column].astype(np.float32)
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth
