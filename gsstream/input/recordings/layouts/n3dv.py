"""N3DV (Neural 3D Video, "Plenoptic Video"): cam00.mp4 ... beside poses_bounds.npy; or the frames taken out of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsstream.input.recordings.base import PointKind
from gsstream.input.recordings.layouts.llff import looks_like_llff, read_llff
from gsstream.input.recordings.pointfiles import read_ply_points
from gsstream.input.recordings.recorded import Recording, SeenPoints

#: Written by the preparation scripts of 4DGaussians, QUEEN and S2GS: the dense cloud of frame 0 from all cameras.
POINTS_FILES = ("points3D_downsample2.ply", "points3D_downsample.ply")
PATTERN = "cam[0-9]*"


def looks_like(folder: Path) -> bool:
    """Say whether there is a poses_bounds.npy beside cam00.mp4, cam00/ or frame000001/cam00.png."""
    return looks_like_llff(folder, PATTERN)


def read(folder: Path) -> Recording:
    """Read N3DV: 18 to 21 cameras, 2704 x 2028, 30 frames per second; cam00 is for tests (paper and released code)."""
    recording = read_llff(folder, PATTERN)

    def points(_: PointKind) -> SeenPoints | None:
        found = [folder / name for name in POINTS_FILES if (folder / name).is_file()]
        if not found:
            return None
        cloud = read_ply_points(found[0])
        # Made from the pictures of all cameras, the test camera's among them: only a leak lets it in.
        return SeenPoints(cloud, np.ones((len(cloud), len(recording.rig)), bool))

    return replace(recording, points=points)
