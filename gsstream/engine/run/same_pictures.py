"""Whether a run that goes on is given the pictures that its stream was made from."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gsstream.core.errors import OutputError
from gsstream.core.frame import Frame
from gsstream.core.storage import packed
from gsstream.input.recordings.origin import public_uri

#: The key of ``metrics.jsonl`` that holds the sums of a frame; every STEP-th row of a picture counts, four hex digits.
PICTURES, STEP, DIGITS = "pictures", 8, 4


def sums(frame: Frame) -> str:
    """Return a short sum over the pictures of each training camera, one after the other."""
    rows = packed(np.ascontiguousarray(frame.images[:, ::STEP]))
    return "".join(f"{zlib.crc32(image.tobytes()):08x}"[:DIGITS] for image in rows)


class KnownPictures:
    """What the lines of ``metrics.jsonl`` say of pictures, held against those that a run that goes on is given."""

    def __init__(self, lines: Iterable[Mapping[str, Any]]) -> None:
        self._said = {int(line["frame"]): str(line[PICTURES]) for line in lines if PICTURES in line}
        #: Frame -> share of the cameras that show something else than they did.
        self._others: dict[int, float] = {}

    def looked_at(self, frame: Frame) -> Frame:
        """Return the frame, and note how many of its pictures are others than they were."""
        said = self._said.get(frame.index)
        if said is not None:
            pairs = zip(_by_camera(said), _by_camera(sums(frame)), strict=False)
            self._others[frame.index] = float(np.mean([before != now for before, now in pairs]))
        return frame

    def check(self, made_from: str, uri: str) -> None:
        """Raise OutputError where pictures are those of another recording; warn where all are others in the same place.

        In the same place a picture of some cameras may have been mended since.

        Arguments:
            made_from: what the stream says of its recording. uri: of the recording that was given.
        """
        now, frame = public_uri(uri), max(self._others, key=self._others.__getitem__, default=0)
        share = self._others.get(frame, 0.0)
        what = f"frame {frame} of {now!r} shows other pictures than those that the stream was made from"
        if share and made_from != now:
            raise OutputError(f"{what}: {made_from!r}, with the same cameras; resume with the same --source")
        if share == 1:
            warnings.warn(f"{what}: another take, or files that are decoded otherwise; it goes on", stacklevel=3)


def _by_camera(said: str) -> list[str]:
    return [said[at : at + DIGITS] for at in range(0, len(said), DIGITS)]
