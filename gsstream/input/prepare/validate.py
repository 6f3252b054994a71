"""``gsstream scene validate``: everything that can be known to be wrong with a scene before a run.

The checks go from cheap to dear and stop at the first stage with an error, so that one fault gives one message and not
its consequences too.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, SourceError
from gsstream.core.frame import Frame, join_frames, shrink_frame
from gsstream.core.install_hints import install_extra
from gsstream.input.prepare.findings import Finding, error, note
from gsstream.input.prepare.match_checks import check_matches
from gsstream.input.prepare.picture_checks import (
    Thumbnails,
    check_blank,
    check_change,
    check_colour,
    check_same,
    read_thumbnails,
)
from gsstream.input.prepare.pose_checks import check_poses, check_swapped
from gsstream.input.prepare.rig_checks import check_axes, check_intrinsics, check_overlap, check_placement
from gsstream.input.prepare.sync_checks import check_sync
from gsstream.input.recordings.base import FilesMissing, Source
from gsstream.input.recordings.canonical import to_file_coordinates
from gsstream.input.seeds.matching import match_images

#: Width of the pictures that are compared over time, and of those whose features are matched.
SMALL, LARGE = 160, 640
FRAMES = 60

Open = Callable[[float], Source]


#: Called with what is being looked at, before a check that takes time.
Say = Callable[[str], None]


def validate(
    open_scene: Open, *, frames: int = FRAMES, features: bool = True, say: Say = lambda _: None
) -> list[Finding]:
    """Return findings about a recording, errors first; none when it is fine."""
    try:
        source = open_scene(1.0)
    except SourceError as fault:
        return [error("files" if isinstance(fault, FilesMissing) else "calibration", str(fault))]
    try:
        found: list[Finding] = []
        for stage in _stages(source, open_scene, frames, features=features, say=say):
            found += _merged(stage)
            if any(finding.severity == "error" for finding in stage):
                break
    finally:
        source.close()
    return sorted(found, key=lambda finding: ("error", "warning", "note").index(finding.severity))


def _merged(found: list[Finding]) -> list[Finding]:
    """More than two findings of one kind are said once."""
    if len(found) < 3 or len({(finding.code, finding.severity) for finding in found}) > 1:
        return found
    return [replace(found[0], message=f"{found[0].message} ({len(found) - 1} more like this)")]


def rig_of(source: Source) -> Cameras:
    """Return training cameras, then test cameras."""
    train, test = source.info.train, source.info.test
    return train.joined(test)


def _stages(source: Source, open_scene: Open, frames: int, *, features: bool, say: Say) -> Iterator[list[Finding]]:
    source = to_file_coordinates(source)
    rig, train = rig_of(source), source.info.train
    yield check_intrinsics(rig)
    try:
        points = source.points()
    except SourceError as fault:
        yield [error("files", str(fault))]
        return
    yield check_placement(rig, len(train), points)
    yield check_axes(rig)
    yield check_overlap(train, train.ids)
    say("checking the scene: reading its pictures")
    try:
        thumbs = _thumbnails(source, open_scene, rig, frames)
        train_frame = source.frame(0, "train")
        first = join_frames(train_frame, source.frame(0, "test"))
    except SourceError as fault:
        yield [error("images", str(fault))]
        return
    yield check_blank(thumbs)
    yield check_colour(thumbs)
    yield check_same(thumbs)
    yield check_change(thumbs)
    # Before clocks: where poses do not fit, what moves seems to be at different places although clocks may be right.
    say("checking the scene: do the poses fit the pictures?")
    yield check_poses(train_frame)
    say("checking the scene: do the clocks agree?")
    clocks = check_sync(thumbs)
    if clocks and features:
        # The same for poses that are wrong in a way that no convention explains.
        yield [finding for finding in _matched(first, rig_only=True) if finding.severity == "error"]
    yield clocks
    say("checking the scene: are cameras exchanged?")
    yield check_swapped(first)
    if features:
        say("checking the scene: matching features between cameras")
        yield _matched(first)


def _thumbnails(source: Source, open_scene: Open, rig: Cameras, frames: int) -> Thumbnails:
    small = open_scene(min(1.0, SMALL / rig.width))
    try:
        known = source.info.num_frames
        return read_thumbnails(to_file_coordinates(small), rig, frames if known is None else min(frames, known))
    finally:
        small.close()


def _matched(frame: Frame, *, rig_only: bool = False) -> list[Finding]:
    if importlib.util.find_spec("pycolmap") is None:
        return [note("epipolar", f"the calibration was not compared with the pictures: {install_extra('sfm')}")]
    small = shrink_frame(frame, -(-frame.cameras.width // LARGE))
    try:
        return check_matches(small.cameras, match_images(small.images), rig_only=rig_only)
    except InputError as fault:
        return [note("epipolar", f"the calibration was not compared with the pictures: {fault}")]
