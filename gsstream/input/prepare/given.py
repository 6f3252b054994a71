"""What is known of raw cameras before anything is matched: the poses and lenses of a calibration, in any layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.raw import RawCamera, find_cameras
from gsstream.input.recordings.calibration import CALIBRATION_FILE, cut_to, read_calibration
from gsstream.input.recordings.detect import LAYOUTS, detect, layouts_of, read_layout
from gsstream.input.recordings.distortion import Lens as Distortion
from gsstream.input.recordings.recorded import check_sizes
from gsstream.input.recordings.sync import align
from gsstream.input.seeds.mapping import Lens


@dataclass(frozen=True, slots=True)
class GivenRig:
    """A calibration: ``viewmats`` [C, 4, 4], and ``lenses`` in pixels of each camera's own pictures.

    ``test``: ids of the test cameras, which never train.
    """

    viewmats: FloatArray
    lenses: tuple[Lens, ...]
    test: tuple[str, ...]
    fps: float
    licence: str


def read_raw(source: str) -> tuple[str, list[RawCamera], GivenRig | None]:
    """Return name and cameras of a recording, and its calibration where it has one.

    Arguments:
        source: a folder of any layout that a run reads, by its files or as ``LAYOUT:DIR``, or of pictures or videos.

    Raises SourceError for anything else.
    """
    scheme, colon, rest = source.partition(":")
    named = scheme if colon and scheme in (*LAYOUTS, "folder") else None
    folder = Path(rest if named else source)
    if folder.is_dir() and named is None:
        known = (folder / CALIBRATION_FILE).exists() or layouts_of(folder)
        named = detect(folder) if known else None
    if named is None:
        return folder.resolve().name, find_cameras(folder), None
    return folder.resolve().name, *(_declared(folder) if named == "folder" else _laid_out(named, folder))


def _declared(folder: Path) -> tuple[list[RawCamera], GivenRig]:
    cameras, known = find_cameras(folder), read_calibration(folder, to_size=True)
    size = known.train.width, known.train.height
    lenses = []
    for camera, K in zip(cameras, (*known.train.Ks, *known.test.Ks), strict=True):
        lenses.append(_lens(np.linalg.inv(cut_to(np.eye(3), camera.size, size)) @ K, None))
    viewmats = np.concatenate([known.train.viewmats, known.test.viewmats])
    return cameras, GivenRig(viewmats, tuple(lenses), known.test.ids, known.fps, known.licence)


def _laid_out(layout: str, folder: Path) -> tuple[list[RawCamera], GivenRig]:
    recording = read_layout(layout, folder)
    check_sizes(recording)
    rig, beside = recording.rig, align(recording.name, recording.clips)
    cameras = []
    for name in rig.ids:
        skip = beside.skip[name]
        clip = recording.clips[name]
        cameras.append(RawCamera(name, (), clip.size, clip, range(skip, skip + beside.num_frames)))
    if len(cameras) < 2:
        raise SourceError(f"{recording.where}: cameras found: {len(cameras)}; expected at least two")
    lenses = tuple(_lens(K, recording.lenses.get(name)) for name, K in zip(rig.ids, rig.Ks, strict=True))
    fps = beside.fps or recording.fps
    return cameras, GivenRig(rig.viewmats, lenses, recording.test, fps, recording.licence)


def _lens(K: FloatArray, distortion: Distortion | None) -> Lens:
    """The lens by the names and in the order of COLMAP."""
    pinhole = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    if distortion is None:
        return Lens("PINHOLE", pinhole)
    k = (*distortion.k, *(0.0,) * 6)
    if distortion.kind == "fisheye":
        return Lens("OPENCV_FISHEYE", (*pinhole, *k[:4]))
    return Lens("FULL_OPENCV", (*pinhole, *k[:2], *distortion.p, *k[2:6]))
