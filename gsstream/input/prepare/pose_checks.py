"""Do the pictures of one instant fit the poses, or those poses read by another convention?

No feature is matched: small pictures are swept by planes, and what counts is how much of their texture lies, at some
depth, where the neighbours see the same. With poses that do not fit, next to nothing does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import EndOfRecording, InputError
from gsstream.core.frame import Frame, shrink_frame
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.findings import Finding, error
from gsstream.input.prepare.match_checks import REPAIRS
from gsstream.input.prepare.picture_checks import Thumbnails, check_blank
from gsstream.input.prepare.rig_checks import check_axes, check_intrinsics, check_overlap, check_placement
from gsstream.input.recordings.base import FrameSource
from gsstream.input.recordings.canonical import to_file_coordinates
from gsstream.input.seeds.sweep import SweepSettings, agreement

#: Width of the pictures that are swept, and how many of them are.
WIDTH, VIEWS = 64, 3
SETTINGS = SweepSettings(planes=16, neighbours=3, windows=(2,), workers=1)
#: Matching cost that counts as the same. Right poses of five recordings: 0.30 to 0.50 of the texture agrees; wrong
#: ones: at most 0.11, and at most a third of what the right ones reach.
SAME, AGREED, TIMES = 0.15, 0.25, 2.5
LEAST = 0.15


def first_look(source: FrameSource) -> list[Finding]:
    """Return what is wrong with the poses of a recording, as far as its rig and its first frame say it at once.

    A part of ``scene validate`` that takes a fraction of a second. Pictures of a recording that still grows are not
    waited for.

    Raises SourceError when frame 0 cannot be read.
    """
    source = to_file_coordinates(source)
    train = source.info.train
    found = [*check_intrinsics(train), *check_placement(train, len(train), None), *check_axes(train)]
    if found:
        return found[:1]
    found = check_overlap(train, train.ids) if len(train) > 1 else []
    if source.info.num_frames is None:
        return found[:1]
    try:
        frame = source.frame(0, "train")
        blank = check_blank(Thumbnails(frame.images[None], train, len(train)))
        return blank[:1] or check_poses(frame) or found[:1]
    except EndOfRecording:
        return found[:1]


def check_poses(frame: Frame) -> list[Finding]:
    """Find poses that explain the pictures of one instant much better when they are read by another convention."""
    if len(frame.cameras) < 3:
        return []
    small = shrink_frame(frame, max(1, round(frame.cameras.width / WIDTH)))
    images, cameras = small.images, small.cameras
    given = _agreement(images, cameras)
    if given >= AGREED:
        return []
    shares = []
    for _, _, repair in REPAIRS:
        poses = np.stack([repair(pose) for pose in cameras.viewmats])
        shares.append(_agreement(images, replace(cameras, viewmats=poses)))
    best = max(shares)
    if best < max(LEAST, TIMES * given):
        return []
    what, cure, _ = REPAIRS[shares.index(best)]
    return [error("axes", (
        f"the pictures of frame {frame.index} fit each other if the poses are {what}, and not as they are given "
        f"({100 * best:.0f} % of their texture is at one place for several cameras, instead of {100 * given:.0f} %): "
        f"{cure}"
    ))]  # fmt: skip


def _agreement(images: FloatArray, cameras: Cameras) -> float:
    try:
        return agreement(images, cameras, SETTINGS, views=VIEWS, limit=SAME)
    except InputError:
        return 0.0  # poses read by this convention have no view in common
