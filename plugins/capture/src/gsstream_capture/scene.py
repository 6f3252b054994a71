"""Calibration without a board: structure from motion on one instant of what the cameras see."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.prepare import PrepareOptions, prepare
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.recordings.lens import Lens
from gsstream_capture.board.solve import camera_row, write_cameras
from gsstream_capture.capture import Say


def calibrate_scene(raw: Path, out: Path, *, each: bool, fps: float, say: Say) -> None:
    """Write ``cameras.json`` with poses and lenses of raw pictures, a folder or a video for each camera.

    The unit is none: structure from motion knows no size. Raises InputError where not every camera can be placed.
    """
    sizes = {camera.name: camera.size for camera in find_cameras(raw)[0]}
    with TemporaryDirectory(prefix="gsstream-") as folder:
        made = prepare(raw, Path(folder) / "scene", PrepareOptions(each=each, frames=1), say)
    if made.left_out:
        raise InputError(
            f"cameras {', '.join(map(repr, made.left_out))} could not be placed by what they see; show something with "
            "texture to all of them, or calibrate with a board: gsstream calibrate board"
        )
    found = made.mapping
    rows = [
        camera_row(name, sizes[name], lens=coefficients(found.Ks[row], found.lenses[row]), w2c=found.viewmats[row])
        for row, name in enumerate(made.names)
    ]
    write_cameras(out, rows, fps=fps, units="none")


def coefficients(K: FloatArray, lens: Lens) -> FloatArray:
    """Return fx, fy, cx, cy, k1, k2, p1, p2, k3 [9] of a lens with at most three radial coefficients."""
    k1, k2, k3 = (*lens.k, 0.0, 0.0, 0.0)[:3]
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, *lens.p, k3])
