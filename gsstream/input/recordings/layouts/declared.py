"""A folder with cameras.json as a rig of clips: videos, lenses that distort, and for ``prepare`` pictures of any size.

Pinhole images of one size need none of it; :class:`~gsstream.input.recordings.multiview.MultiviewSource` reads them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsstream.input.recordings.calibration import CALIBRATION_FILE, Calibration, frame_path, is_video, read_calibration
from gsstream.input.recordings.clips import Clip, ImageClip
from gsstream.input.recordings.multiview import POINTS_FILE, check_files, read_points
from gsstream.input.recordings.recorded import Recording, SeenPoints


def read(folder: Path, *, any_sizes: bool = False) -> Recording:
    """Read the calibration and open its pictures.

    Raises SourceError for a faulty calibration, for what is missing, and for cameras of several sizes.
    """
    known = read_calibration(folder, any_sizes=any_sizes)
    check_files(folder, known)
    train, test = known.train, known.test
    rig = train.joined(test)
    return Recording(
        name=known.name,
        where=str(folder / CALIBRATION_FILE),
        rig=rig,
        clips={name: _clip(folder, known, name) for name in rig.ids},
        test=test.ids,
        fps=known.fps,
        lenses=known.lenses,
        sizes=known.sizes,
        points=lambda: _points(folder, known),
        licence=known.licence,
    )


def _clip(folder: Path, known: Calibration, name: str) -> Clip:
    pattern = known.patterns[name]
    if not is_video(pattern):
        return ImageClip([folder / frame_path(pattern, t) for t in range(known.num_frames)])
    from gsstream.input.recordings.video import VideoClip

    return VideoClip(folder / pattern, known.num_frames or None)


def _points(folder: Path, known: Calibration) -> SeenPoints | None:
    """The points that ship. Every training camera counts as having taken part, since the file does not say which."""
    path = folder / POINTS_FILE
    if not path.exists():
        return None
    cloud = read_points(path, "recording")
    return SeenPoints(
        cloud, np.tile([*(True for _ in known.train.ids), *(False for _ in known.test.ids)], (len(cloud), 1))
    )
