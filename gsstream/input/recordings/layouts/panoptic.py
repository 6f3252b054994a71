"""CMU Panoptic as Dynamic 3D Gaussians ships it: train_meta.json, test_meta.json, ims/CAMERA/000000.jpg.

Per instant t and camera c: ``k[t][c]`` 3 x 3 pixels, ``w2c[t][c]`` 4 x 4 world to camera with OpenCV axes,
``fn[t][c]`` the picture below ims/, ``cam_id[t][c]``; ``w``, ``h`` once. Intrinsics are used with the origin at the
image corner, as that project's renderer does. World units are about metres. Pictures are undistorted already.
``init_pt_cld.npz``: ``data`` [P, 7] xyz, rgb in [0, 1], foreground; it comes from depth sensors, not from the cameras.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud
from gsstream.input.recordings.calibration import read_json
from gsstream.input.recordings.clips import listed_clips
from gsstream.input.recordings.foreign import Keys, check_keys, inside, left_out, matrix, pixels
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.pointfiles import check_archive, colours
from gsstream.input.recordings.recorded import Recording, SeenPoints
from gsstream.input.recordings.rigs.camera import RigCamera, assembled_rig, say_unused

TRAIN, TEST, IMAGES, POINTS = "train_meta.json", "test_meta.json", "ims", "init_pt_cld.npz"

#: Keys that Dynamic 3D Gaussians writes.
_KEYS = Keys(read="w h k w2c fn cam_id", idle="near far", refused="dist distCoef fisheye")


def looks_like(folder: Path) -> bool:
    """Say whether there is a train_meta.json beside ims/."""
    return (folder / TRAIN).is_file() and (folder / IMAGES).is_dir()


def read(folder: Path) -> Recording:
    """Read CMU Panoptic: 27 training cameras, 640 x 360, 150 frames; test_meta.json has the test cameras."""
    rig: dict[str, RigCamera] = {}
    pictures: dict[str, list[Path]] = {}
    test: list[str] = []
    for name in (TRAIN, TEST):
        path = folder / name
        if name == TEST and not path.is_file():
            continue
        meta = _load(path)
        size = pixels(str(path), "w", meta["w"]), pixels(str(path), "h", meta["h"])
        names = [f"cam{number}" for number in _fixed(path, meta, "cam_id")]
        files = _files(path, meta, len(names))
        poses, Ks = (_matrices(path, meta, key, cameras=len(names), side=side) for key, side in (("w2c", 4), ("k", 3)))
        for c, camera in enumerate(names):
            if camera in rig:
                raise SourceError(f"{path}: camera {camera!r} is there twice, in {TRAIN} and {TEST} or within one")
            pictures[camera] = [folder / IMAGES / row[c] for row in files]
            rig[camera] = RigCamera(
                name=camera, w2c=poses[c], K=Ks[c], lens=Lens("radial", ()), size=size, border=False
            )
        test = names if name == TEST else test
    seen = {name: own for name, own in pictures.items() if any(path.is_file() for path in own)}
    left_out(str(folder / TRAIN), "without pictures", [name for name in rig if name not in seen], len(seen))
    clips = listed_clips(seen)
    say_unused(folder / TRAIN, clips)
    return assembled_rig(
        folder,
        folder / TRAIN,
        rig,
        clips,
        test=tuple(name for name in test if name in seen),
        points=lambda _: _points(folder / POINTS, len(seen)),
        licence="CMU Panoptic: research use only",
    )


def _load(path: Path) -> dict[str, Any]:
    known = read_json(path)
    if missing := [key for key in ("w", "h", "k", "w2c", "fn", "cam_id") if key not in known]:
        raise SourceError(f"{path}: expected the keys w, h, k, w2c, fn, cam_id; missing: {', '.join(missing)}")
    check_keys(str(path), [known], _KEYS)
    return known


def _fixed(path: Path, meta: dict[str, Any], key: str) -> list[Any]:
    """A list per instant that must be the same at every instant."""
    rows = meta[key]
    if not isinstance(rows, list) or not rows or not isinstance(rows[0], list) or not rows[0]:
        raise SourceError(f"{path}: {key!r} must be a list per instant of lists per camera")
    if not all(type(cell) in (int, str) for cell in rows[0]):
        raise SourceError(f"{path}: {key!r} must hold whole numbers or names, got {rows[0]!r:.60}")
    for t, row in enumerate(rows):
        if row != rows[0]:
            raise SourceError(f"{path}: {key!r} of instant {t} differs from instant 0; cameras must stay the same")
    first: list[Any] = rows[0]
    return first


def _files(path: Path, meta: dict[str, Any], cameras: int) -> list[list[str]]:
    rows: list[list[str]] = meta["fn"]
    good = isinstance(rows, list) and all(
        isinstance(row, list) and len(row) == cameras and all(isinstance(f, str) for f in row) for row in rows
    )
    if not good or len(rows) != len(meta["cam_id"]):
        raise SourceError(f"{path}: 'fn' must name one picture per instant and camera ({cameras} cameras)")
    return [[inside(f"{path}: picture", name) for name in row] for row in rows]


def _matrices(path: Path, meta: dict[str, Any], key: str, cameras: int, side: int) -> np.ndarray[Any, Any]:
    values = matrix(str(path), key, meta[key], (len(meta["fn"]), cameras, side, side))
    moved = ~(np.abs(values - values[:1]).max((1, 2, 3)) <= 1e-6 * np.abs(values[0]).max())
    if moved.any():
        raise SourceError(
            f"{path}: {key!r} changes with time, first at instant {int(moved.argmax())}; only cameras that stand still "
            "are supported"
        )
    first: np.ndarray[Any, Any] = values[0]
    return first


def _points(path: Path, cameras: int) -> SeenPoints | None:
    if not path.is_file():
        return None
    check_archive(path)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            data = arrays["data"]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise SourceError(f"{path}: expected a numpy archive with an array 'data': {error}") from error
    if data.ndim != 2 or data.shape[1] not in (6, 7) or not np.isfinite(data).all():
        raise SourceError(f"{path}: expected 'data' [P, 7] of finite numbers, got {list(data.shape)}")
    cloud = PointCloud(data[:, :3].astype(np.float64), colours(str(path), data[:, 3:6]), path.name)
    return SeenPoints(cloud, np.zeros((len(cloud), cameras), bool))
