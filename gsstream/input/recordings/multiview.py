"""A recording in a folder: cameras.json (schema "opencv-multiview-1"), image files, optional points_frame0.npz."""

from __future__ import annotations

import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.core.storage import unpacked
from gsstream.input.recordings.base import FilesMissing, PointKind, SourceInfo, Split, check_index
from gsstream.input.recordings.calibration import Calibration, frame_path, is_video, read_calibration
from gsstream.input.recordings.depth_maps import FOLDER
from gsstream.input.recordings.images import read_stored
from gsstream.input.recordings.sync import RecordingWarning

POINTS_FILE = "points_frame0.npz"
#: Points that whoever made them trusts less than this, from 0 to 1, are left out.
TRUSTED = 0.5
#: Steps of float32 above this share of the points' spread move them visibly.
COARSE = 1e-3


class MultiviewSource:
    """Frames from image files, area-averaged to ``scale``. Thread-safe: reading keeps no state.

    Raises SourceError at construction for a faulty calibration or missing image files, on reading for a faulty image.
    """

    def __init__(self, folder: Path | str, *, scale: float = 1.0, uri: str | None = None) -> None:
        self._folder = Path(folder)
        calibration = read_calibration(self._folder)
        if calibration.is_raw:
            raise SourceError(f"{folder}: it holds videos, or 'distortion', which open_source reads")
        self._native = (calibration.train.width, calibration.train.height)
        self._target = scaled_size(self._native, scale)
        self._patterns = calibration.patterns
        check_files(self._folder, calibration)
        self._info = SourceInfo(
            name=calibration.name,
            uri=str(folder) if uri is None else uri,
            num_frames=calibration.num_frames,
            fps=calibration.fps,
            train=calibration.train.scaled(*self._target),
            test=calibration.test.scaled(*self._target),
            licence=calibration.licence,
            depth_maps=self._folder / FOLDER,
        )

    @property
    def info(self) -> SourceInfo:
        """What the recording says about itself; cameras at the size that ``frame`` delivers."""
        return self._info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError naming the file when an image is missing, damaged or of another size."""
        info = self._info
        check_index(info, index)
        cameras = info.train if split == "train" else info.test
        images: FloatArray = np.empty((len(cameras), self._target[1], self._target[0], 3), np.float32)
        for i, camera_id in enumerate(cameras.ids):
            images[i] = self.image(index, camera_id)
        return Frame(index, index / info.fps, images, cameras)

    def image(self, index: int, camera: str) -> FloatArray:
        """Return one camera's image [H, W, 3]. Raises SourceError like ``frame``."""
        return unpacked(self.stored_image(index, camera))

    def stored_image(self, index: int, camera: str) -> Any:
        """Return the same as uint8, of which 255 is 1.0, where that holds it."""
        check_index(self._info, index)
        return read_stored(self._folder / frame_path(self._patterns[camera], index), self._native, self._target)

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return points of frame 0 that ship with the recording, or None when it ships none.

        Raises SourceError when the file is damaged or does not hold the asked kind.
        """
        path = self._folder / POINTS_FILE
        if not path.exists():
            return None
        return read_points(path, kind)

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return (width, height) after scaling by a factor in (0, 1], rounded to whole pixels, at least one."""
    if not 0 < scale <= 1:
        raise SourceError(f"scale: expected a factor in (0, 1], got {scale!r}; recordings are never enlarged")
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def read_points(path: Path, kind: PointKind) -> PointCloud:
    """Read [P, 3] points and uint8 colours from an npz file, without those of a ``confidence`` [P] below a half.

    Raises SourceError naming file and array.
    """
    prefix = "" if kind == "recording" else "sparse_"
    try:
        with np.load(path, allow_pickle=False) as arrays:
            if not isinstance(arrays, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array (.npy)")
            names = list(arrays.files)
            missing = [n for n in (f"{prefix}xyz", f"{prefix}rgb") if n not in names]
            if missing:
                raise SourceError(f"{path}: no array {missing[0]!r} for points {kind!r}; it holds {', '.join(names)}")
            xyz, rgb = arrays[f"{prefix}xyz"], arrays[f"{prefix}rgb"]
            trust = arrays[f"{prefix}confidence"] if f"{prefix}confidence" in names else None
    except SourceError:
        raise
    except (OSError, ValueError, EOFError, TypeError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise SourceError(f"{path}: cannot be read as a numpy archive: {error}; write it with numpy.savez") from error
    shaped = xyz.ndim == 2 and xyz.shape[1] == 3 and rgb.shape == xyz.shape
    if not shaped or rgb.dtype != np.uint8 or xyz.dtype.kind not in "fiu":
        raise SourceError(
            f"{path}: expected {prefix}xyz [P, 3] float and {prefix}rgb [P, 3] uint8, "
            f"got {list(xyz.shape)} {xyz.dtype} and {list(rgb.shape)} {rgb.dtype}"
        )
    with np.errstate(over="ignore"):  # what does not fit into float32 becomes infinite and is refused
        fits = np.isfinite(xyz.astype(np.float32))
    if not fits.all():
        raise SourceError(f"{path}: {int((~fits).any(1).sum())} of {len(xyz)} points are not finite")
    if xyz.dtype == np.float32 and len(xyz) > 1:
        step = float(np.spacing(np.abs(xyz).max()))
        spread = float(np.median(np.abs(xyz - np.median(xyz, axis=0))))
        if step > COARSE * spread:
            warnings.warn(
                f"{path}: {prefix}xyz is float32, whose steps are {step:.2g} this far from the origin, and the points "
                f"spread over {spread:.2g}: write float64, or move poses and points to the origin",
                RecordingWarning,
                stacklevel=2,
            )
    if trust is not None:
        kept = _trusted(path, f"{prefix}confidence", trust, len(xyz))
        xyz, rgb = xyz[kept], rgb[kept]
    colors = rgb.astype(np.float32) / np.float32(255)
    return PointCloud(xyz.astype(np.float64), colors, f"{path.name} ({kind})")


def _trusted(path: Path, name: str, trust: FloatArray, count: int) -> BoolArray:
    """[P] bool: which points their maker trusts. Raises SourceError for other numbers, and where none are left."""
    if trust.shape != (count,) or trust.dtype.kind not in "fiu" or not ((trust >= 0) & (trust <= 1)).all():
        raise SourceError(f"{path}: expected {name} [{count}] from 0 to 1, got {list(trust.shape)} {trust.dtype}")
    kept: BoolArray = trust >= TRUSTED
    if not kept.any():
        raise SourceError(f"{path}: {name} is below {TRUSTED} for every point: scale it to 1, or leave the array out")
    return kept


def check_files(folder: Path, calibration: Calibration) -> None:
    """Raise SourceError for what is declared and is not there, before anything is trained on what is."""
    for camera_id in (*calibration.train.ids, *calibration.test.ids):
        pattern = calibration.patterns[camera_id]
        if is_video(pattern):
            if not (folder / pattern).is_file():
                raise FilesMissing(f"{folder}: camera {camera_id!r} has no video; expected {folder / pattern}")
            continue
        if "%" not in pattern and calibration.num_frames > 1:
            raise SourceError(
                f"{folder}: camera {camera_id!r}: {calibration.num_frames} frames are declared, but 'frames' "
                f"{pattern!r} names a single image; use a pattern such as %06d, or name a video"
            )
        _check_images(folder, camera_id, pattern, calibration.num_frames)


def _check_images(folder: Path, camera_id: str, pattern: str, count: int) -> None:
    _check_span(folder, camera_id, pattern, count)
    paths = [folder / frame_path(pattern, t) for t in range(count)]
    missing = [p for p in paths if not p.is_file()]
    if len(missing) == len(paths):
        raise FilesMissing(f"{folder}: camera {camera_id!r} has no frames; expected {missing[0]} and its followers")
    if missing:
        raise FilesMissing(
            f"{folder}: camera {camera_id!r}: {len(missing)} of {len(paths)} frames are missing, the first is "
            f'{missing[0]}; restore them or lower "frames" in cameras.json'
        )


def _check_span(folder: Path, camera_id: str, pattern: str, count: int) -> None:
    """The first and the last image first: a count of millions is answered at once, without a list of names."""
    for index in (0, count - 1):
        path = folder / frame_path(pattern, index)
        try:
            there = path.is_file()
        except OSError as error:
            raise SourceError(f"{folder}: camera {camera_id!r}: {str(path)[:100]}...: {error.strerror}") from error
        if not there and count > 100_000:
            raise FilesMissing(f"{folder}: camera {camera_id!r}: {count} frames are declared, but {path} is missing")
