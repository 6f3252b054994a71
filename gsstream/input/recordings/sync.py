"""Do the clips of a rig show the same instants? Counts, numbers, rates and starts, compared and told with numbers."""

from __future__ import annotations

import bisect
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.input.recordings.clips import Clip
from gsstream.input.recordings.video import VideoClip

#: Differences between clips of more than this many frames, in number or in time, are reported.
NOTABLE = 0.5


class RecordingWarning(UserWarning):
    """Something about a recording deserves a look; reading goes on."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How clips are laid beside each other."""

    num_frames: int  # instants that all clips have
    #: Camera -> pictures left out at its beginning, so that equal numbers stand beside each other.
    skip: Mapping[str, int]
    fps: float | None  # of the videos; None when all clips are images


def align(name: str, clips: Mapping[str, Clip]) -> Alignment:
    """Lay clips beside each other; numbered images by their numbers, videos by counting, single pictures as they are.

    Numbers may begin anywhere and leave some out, if all cameras leave out the same.

    Warns (RecordingWarning) about unequal lengths and numbers, common gaps, videos that start at different times,
    uneven time stamps, and what a video says of its pictures. Raises SourceError when no instant is common, for a gap
    in one camera alone, or when rates differ so much that counting frames drifts.
    """
    if all(clip.num_frames == 1 for clip in clips.values()):
        shared: Sequence[int] = [0]
        skip = dict.fromkeys(clips, 0)
        notes: list[str] = []
    else:
        shared = _shared(name, clips)
        skip = {i: bisect.bisect_left(clip.numbers, shared[0]) for i, clip in clips.items()}
        notes = _lengths(clips, shared) + _common_gap(shared)
    videos = {i: clip for i, clip in clips.items() if isinstance(clip, VideoClip)}
    for doubt in dict.fromkeys(doubt for clip in videos.values() for doubt in clip.doubts):
        notes.append(f"{', '.join(i for i, clip in videos.items() if doubt in clip.doubts)}: {doubt}")
    fps = _common_rate(name, videos, len(shared)) if videos else None
    if fps:
        notes += _starts(videos, fps) + _uneven(videos)
    for note in notes:
        warnings.warn(f"recording {name!r}: {note}", RecordingWarning, stacklevel=2)
    return Alignment(len(shared), skip, fps)


def _shared(name: str, clips: Mapping[str, Clip]) -> list[int]:
    """The numbers of the instants between the latest first and the earliest last picture, which all cameras have."""
    start = max(clip.numbers[0] for clip in clips.values())
    last = min(clip.numbers[-1] for clip in clips.values())
    if last < start:
        raise SourceError(
            f"recording {name!r}: no frame number is common to all cameras: "
            + ", ".join(f"{i} has {c.numbers[0]} to {c.numbers[-1]}" for i, c in clips.items())
        )
    inside = {i: {number for number in clip.numbers if start <= number <= last} for i, clip in clips.items()}
    every = set().union(*inside.values())
    for i, numbers in inside.items():
        if lacking := sorted(every - numbers):
            raise SourceError(
                f"{clips[i].where}: camera {i!r}: frame {lacking[0]} is missing ({len(lacking)} of {len(every)} are), "
                "which other cameras have; a gap shifts this camera against the others: restore the file, or number "
                "the frames of all cameras alike"
            )
    return sorted(every)


def _common_gap(shared: Sequence[int]) -> list[str]:
    """A note where steps from one number to the next differ; every second number, say, is a rate and no gap."""
    steps = np.diff(shared)
    if not len(steps) or steps.min() == steps.max():
        return []
    at = int(np.argmax(steps > steps.min()))
    return [
        f"no camera has a frame between the numbers {shared[at]} and {shared[at + 1]}; frames are counted, so that "
        "everything jumps there"
    ]


def _lengths(clips: Mapping[str, Clip], shared: Sequence[int]) -> list[str]:
    start, last, spans = shared[0], shared[-1], [(clip.numbers[0], clip.numbers[-1]) for clip in clips.values()]
    if len(set(spans)) == 1:
        return []
    listed = ", ".join(
        f"{i} {c.num_frames} from {c.numbers[0]}" for i, c in clips.items() if c.num_frames != len(shared)
    )
    limits = [
        i
        for i, (first, end) in zip(clips, spans, strict=True)
        if (first == start and any(other < start for other, _ in spans))
        or (end == last and any(other > last for _, other in spans))
    ]
    return [
        f"cameras differ in their frames ({listed}); the {len(shared)} common ones are used, from number {start}; the "
        f"span is that of {', '.join(limits)}"
    ]


def _common_rate(name: str, videos: Mapping[str, VideoClip], frames: int) -> float:
    rates = {i: clip.fps for i, clip in videos.items()}
    slow, fast = min(rates.values()), max(rates.values())
    drift = frames * (fast / slow - 1)
    if drift > NOTABLE:
        listed = ", ".join(f"{i} {rate:.6g}" for i, rate in rates.items())
        raise SourceError(
            f"recording {name!r}: cameras run at different rates (frames per second: {listed}); counting frames would "
            f"drift by {drift:.1f} frames over {frames}; convert the videos to one rate"
        )
    return slow


def _starts(videos: Mapping[str, VideoClip], fps: float) -> list[str]:
    starts = {i: clip.start_seconds * fps for i, clip in videos.items()}
    earliest = min(starts.values())
    late = {i: at - earliest for i, at in starts.items() if at - earliest > NOTABLE}
    if not late:
        return []
    listed = ", ".join(f"{i} {frames:.1f}" for i, frames in late.items())
    setting = "+".join(f"{i}@{-round(frames)}" for i, frames in late.items())
    return [
        f"by their time stamps some videos start later than the first (frames: {listed}); frames are counted, not "
        f"timed. If the time stamps are right: --source disturbed:time_offset={setting}:SOURCE"
    ]


def _uneven(videos: Mapping[str, VideoClip]) -> list[str]:
    notes = []
    for camera, clip in videos.items():
        frame, late = clip.largest_gap
        if abs(late) > NOTABLE:
            notes.append(
                f"{camera}: time stamps are uneven: frame {frame} comes {late:+.1f} frames off its place; the camera "
                "dropped frames or its rate varies, and it may run ahead of the others from there on"
            )
    return notes
