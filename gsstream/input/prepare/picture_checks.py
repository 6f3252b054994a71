"""What each camera's pictures give away: blank, frozen, repeated, of another camera, jumping in brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.input.prepare.findings import Finding, error, warning
from gsstream.input.recordings.base import Source

FLAT = 2.5 / 255
JUMP = 0.08
#: Mean distance between the channels of a pixel below which a camera is grey, and above which it has colours.
GREY, COLOURED = 0.5 / 255, 4.0 / 255


@dataclass(frozen=True, slots=True)
class Thumbnails:
    """Small pictures of all cameras (training first): ``images`` [T, C, h, w, 3] float32 in [0, 1]."""

    images: FloatArray
    cameras: Cameras
    train: int


def read_thumbnails(source: Source, cameras: Cameras, frames: int) -> Thumbnails:
    """Read the first ``frames`` frames of all ``cameras``.

    Raises SourceError for the first image that cannot be read.
    """
    pairs = ((source.frame(t, "train").images, source.frame(t, "test").images) for t in range(frames))
    images = np.stack([np.concatenate(pair) for pair in pairs])
    return Thumbnails(images, cameras, len(source.info.train))


def check_blank(thumbs: Thumbnails) -> list[Finding]:
    """Find cameras, or single frames of them, without any structure."""
    flat = thumbs.images.std(axis=(2, 3)).max(-1) < FLAT
    found = []
    for c, name in enumerate(thumbs.cameras.ids):
        frames = np.flatnonzero(flat[:, c])
        if len(frames) == 0:
            continue
        level = float(thumbs.images[frames[0], c].mean())
        what = "black" if level < 0.04 else "of one colour"
        if 2 * len(frames) > len(flat):
            found.append(error("blank", f"camera {name!r} is {what} (mean {level:.2f}, no structure); take it out"))
        else:
            found.append(
                error(
                    "blank",
                    f"camera {name!r}: {_listed(frames)} {what} (no structure); export again, or end the "
                    "recording before",
                )
            )
    return found


def check_colour(thumbs: Thumbnails) -> list[Finding]:
    """Find cameras whose pictures are grey while those of others have colours."""
    apart = np.ptp(thumbs.images, axis=-1).mean((0, 2, 3))
    if np.median(apart) < COLOURED:
        return []
    return [
        warning(
            "colour",
            f"camera {thumbs.cameras.ids[c]!r} is grey, most others have colours; its pictures pull the colours of all "
            "that it sees towards grey. Export it again, or take it out",
        )
        for c in np.flatnonzero(apart < GREY)
        if thumbs.images[:, c].std() > FLAT
    ]


def check_same(thumbs: Thumbnails) -> list[Finding]:
    """Find two cameras whose pictures of frame 0 are the same bits."""
    found, first = [], thumbs.images[0]
    for a in range(len(first)):
        for b in range(a + 1, len(first)):
            if np.array_equal(first[a], first[b]):
                leak = a < thumbs.train <= b
                kinds = "a training camera and a test camera" if leak else "two cameras"
                found.append(
                    error(
                        "same",
                        f"cameras {thumbs.cameras.ids[a]!r} and {thumbs.cameras.ids[b]!r}, {kinds}, show the same "
                        "pictures; take one of them out, or export the right ones",
                    )
                )
    return found


def check_change(thumbs: Thumbnails) -> list[Finding]:
    """Find frozen cameras, repeated frames and jumps of brightness, each seen against the other cameras."""
    if len(thumbs.images) < 3:
        return []
    still = (np.diff(thumbs.images, axis=0) == 0).all(axis=(2, 3, 4))
    # A frame in which half of the cameras see no change counts as one in which nothing changes.
    busy = still.mean(1) < 0.5
    frozen = still[busy].all(0) if busy.any() else np.zeros(still.shape[1], bool)
    found = [
        error(
            "frozen",
            f"camera {name!r} shows one picture in all {len(thumbs.images)} frames while others change; check its "
            "capture, or take it out",
        )
        for name, stands in zip(thumbs.cameras.ids, frozen, strict=True)
        if stands
    ]
    usual = still.mean(0) <= 0.2
    for c in np.flatnonzero(usual & ~frozen):
        frames = np.flatnonzero(still[:, c] & (still.mean(1) < 0.3)) + 1
        if len(frames):
            found.append(
                error(
                    "repeated",
                    f"camera {thumbs.cameras.ids[c]!r}: {_listed(frames)} the same picture as the one before "
                    "while others go on; a frame was lost there. Export again, and check that the rest is in step",
                )
            )
    return found or check_brightness(thumbs)


def check_brightness(thumbs: Thumbnails) -> list[Finding]:
    """Find jumps of the median brightness between two frames, in one camera or in all."""
    logs = np.log(thumbs.images.mean(-1) + np.float32(0.02))
    steps = np.median(np.diff(logs, axis=0), axis=(2, 3))
    common = np.median(steps, axis=1)
    found = [
        warning(
            "brightness",
            f"all cameras change by {100 * (np.exp(common[t]) - 1):+.0f} % in brightness at frame {t + 1}: light "
            "or exposure. Lock the exposure; a stream pays for such a frame with a large packet",
        )
        for t in np.flatnonzero(np.abs(common) > JUMP)
    ]
    own = np.abs(steps - common[:, None])
    for c in np.flatnonzero(own.max(0) > JUMP):
        when = int(own[:, c].argmax())
        found.append(
            warning(
                "brightness",
                f"camera {thumbs.cameras.ids[c]!r} jumps by {100 * (np.exp(steps[when, c]) - 1):+.0f} % in "
                f"brightness at frame {when + 1}, alone; switch its automatic exposure off",
            )
        )
    return found


def _listed(frames: IntArray) -> str:
    """``frame 3 is`` or ``frames 3, 4 and 2 more are``."""
    if len(frames) == 1:
        return f"frame {frames[0]} is"
    more = f" and {len(frames) - 3} more" if len(frames) > 3 else ""
    return f"frames {', '.join(map(str, frames[:3]))}{more} are"
