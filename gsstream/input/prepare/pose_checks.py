"""Do the pictures of one instant fit the poses, or those poses read by another convention?

No feature is matched: small pictures are swept by planes, and what counts is how much of their texture lies, at some
depth, where the neighbours see the same. With wrong poses, nearly no texture agrees.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import EndOfRecording
from gsstream.core.frame import Frame, join_frames, shrink_frame
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.findings import Finding, error
from gsstream.input.prepare.match_checks import REPAIRS
from gsstream.input.prepare.picture_checks import Thumbnails, check_blank
from gsstream.input.prepare.rig_checks import check_axes, check_intrinsics, check_overlap, check_placement
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.canonical import to_file_coordinates
from gsstream.input.seeds.sweep import SweepSettings, agreements

#: Width of the pictures that are swept, and how many of them are.
WIDTH, VIEWS = 64, 3
SETTINGS = SweepSettings(planes=16, neighbours=3, windows=(2,), workers=1)
#: Matching cost up to which texture agrees. Right poses of five recordings: 0.30 to 0.50 of the texture agrees; wrong
#: ones: at most 0.11, and at most a third of what the right ones reach.
SAME, AGREED, TIMES = 0.15, 0.25, 2.5
LEAST = 0.15
#: The cameras that agree least, if less than this share of what is usual, are tried with each other's pose; both must
#: then agree so much more. In five recordings the right exchange made it 1.9 times as much or more, others 1.3.
STAND_OUT, SUSPECTS, EXCHANGED = 0.8, 6, 1.7


def first_look(source: Source) -> list[Finding]:
    """Return what is wrong with the poses, as far as the rig and the first frame say it in a fraction of a second.

    Test cameras take part in the check of swapped poses alone. Raises SourceError when frame 0 cannot be read.
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
        if blank := check_blank(Thumbnails(frame.images[None], train, len(train))):
            return blank[:1]
        frame = _small(frame)
        return check_poses(frame) or check_swapped(join_frames(frame, _small(source.frame(0, "test")))) or found[:1]
    except EndOfRecording:
        return found[:1]


def check_poses(frame: Frame) -> list[Finding]:
    """Find poses that explain the pictures of one instant much better when they are read by another convention."""
    if len(frame.cameras) < 3:
        return []
    small = _small(frame)
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
    return [
        error(
            "axes",
            f"the pictures of frame {frame.index} fit each other if the poses are {what}, and not as they are "
            f"given ({100 * best:.0f} % of their texture is at one place for several cameras, instead of "
            f"{100 * given:.0f} %): {cure}",
        )
    ]


def check_swapped(frame: Frame) -> list[Finding]:
    """Find two cameras that agree with the others only if each has the other's pose."""
    small = _small(frame)
    images, cameras = small.images, small.cameras
    count = len(cameras)
    if count < 4:
        return []
    own = agreements(images, cameras, SETTINGS, views=range(count), limit=SAME)
    if not np.isfinite(own).any():
        return []
    usual = float(np.median(own[np.isfinite(own)]))
    suspects = [int(c) for c in np.argsort(own)[:SUSPECTS] if own[c] < STAND_OUT * usual]
    for a, b in combinations(sorted(suspects), 2):
        order = list(range(count))
        order[a], order[b] = b, a
        moved = replace(cameras, viewmats=cameras.viewmats[order], Ks=cameras.Ks[order])
        after = agreements(images, moved, SETTINGS, views=(a, b), limit=SAME)
        if (after > np.maximum(EXCHANGED * own[[a, b]], usual / 2)).all():
            return [
                error(
                    "axes",
                    f"cameras {cameras.ids[a]!r} and {cameras.ids[b]!r} are swapped: the pictures of frame "
                    f"{frame.index} fit with each other's pose; exchange their images or their poses",
                )
            ]
    return []


def _small(frame: Frame) -> Frame:
    """Pictures of about WIDTH pixels, float32; those of a frame that is small stay as they are."""
    return shrink_frame(frame, max(1, round(frame.cameras.width / WIDTH))).as_float32()


def _agreement(images: FloatArray, cameras: Cameras) -> float:
    views = np.unique(np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int))
    shares = agreements(images, cameras, SETTINGS, views=views.tolist(), limit=SAME)
    known = shares[np.isfinite(shares)]
    return float(known.mean()) if len(known) else 0.0
