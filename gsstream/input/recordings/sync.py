"""Do the clips of a rig show the same instants? Counts, numbers, rates and starts, compared and told with numbers."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

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
    """Lay clips beside each other; numbered images by their numbers, videos by counting.

    Warns (RecordingWarning) about unequal lengths and numbers, videos that start at different times, and uneven time
    stamps. Raises SourceError when no instant is common, or when rates differ so much that counting frames drifts.
    """
    start = max(clip.first for clip in clips.values())
    stop = min(clip.first + clip.num_frames for clip in clips.values())
    if stop <= start:
        raise SourceError(
            f"recording {name!r}: no frame number is common to all cameras: "
            + ", ".join(f"{i} has {c.first} to {c.first + c.num_frames - 1}" for i, c in clips.items())
        )
    notes = _lengths(clips, start, stop)
    videos = {i: clip for i, clip in clips.items() if isinstance(clip, VideoClip)}
    fps = _common_rate(name, videos, stop - start) if videos else None
    if fps:
        notes += _starts(videos, fps) + _uneven(videos)
    for note in notes:
        warnings.warn(f"recording {name!r}: {note}", RecordingWarning, stacklevel=2)
    return Alignment(stop - start, {i: start - clip.first for i, clip in clips.items()}, fps)


def _lengths(clips: Mapping[str, Clip], start: int, stop: int) -> list[str]:
    spans = {(clip.first, clip.first + clip.num_frames) for clip in clips.values()}
    if len(spans) == 1:
        return []
    told = ", ".join(f"{i} {c.num_frames} from {c.first}" for i, c in clips.items() if c.num_frames != stop - start)
    limits = [
        i
        for i, c in clips.items()
        if (c.first == start and any(o.first < start for o in clips.values()))
        or (c.first + c.num_frames == stop and any(o.first + o.num_frames > stop for o in clips.values()))
    ]
    return [
        f"cameras differ in their frames ({told}); the {stop - start} common ones are used, from number {start}; the "
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
