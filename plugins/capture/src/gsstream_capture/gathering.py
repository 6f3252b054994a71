"""From the pieces in which RTP carries a picture to all of it, as early as it is whole. Pure: bytes in, bytes out.

The bit that marks the last piece does not come through FFmpeg, whose parser therefore holds every picture until the
next one begins: a tenth of a second at ten pictures a second. So it is learned how a camera cuts its pictures: the
pieces of a unit (NAL) are of one length, but for a shorter last one (as RFC 6184, section 5.8, and RFC 7798, section
4.4.3, allow and senders do), and there are as many slices in every picture of a kind.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

#: Codecs of which FFmpeg puts the pieces together itself, by their marks.
WHOLE: Final = frozenset({"mjpeg"})
#: Codecs whose last piece is learned -> bytes of a unit's header. Pictures of others wait for the next one.
HEADER: Final = {"h264": 1, "hevc": 2}
#: Before each unit.
START: Final = b"\0\0\0\1"
#: Pictures in turn whose last piece must have been told before that is believed.
LEARNED: Final = 20


@dataclass(frozen=True, slots=True)
class Gathered:
    """One picture. ``key``: what follows needs nothing before it; ``cut``: a part of it was handed out as the whole."""

    data: bytes
    stamp: int | None
    key: bool
    cut: bool = False


@dataclass(slots=True)
class _Coming:
    """The picture that is coming."""

    stamp: int | None = None
    pieces: list[bytes] = field(default_factory=list)
    slices: int = 0
    kind: int = -1  # of its first slice
    slicing: bool = False  # the unit that comes is a slice
    key: bool = False
    told: int = 0  # pieces after which it looked whole first
    given: bool = False  # it was handed out
    cut: bool = False


@dataclass(slots=True)
class Gathering:
    """The pieces of one connection. ``codec``: by FFmpeg's name."""

    codec: str
    #: Whether a picture that was handed out went on: nothing is handed out early any more.
    wrong: bool = False
    _coming: _Coming = field(default_factory=_Coming)
    _longest: int = 0  # bytes of the longest piece that goes on with a unit
    _slices: dict[int, int] = field(default_factory=dict)  # kind of the first slice -> most slices of such a picture
    _right: int = 0  # pictures in turn whose last piece was told

    def push(self, piece: bytes, stamp: int | None) -> list[Gathered]:
        """Take a piece, and return the pictures that are whole with it; the pieces of a picture have one stamp."""
        out = []
        if stamp != self._coming.stamp or stamp is None:
            out = self._closed()
            self._coming = _Coming(stamp)
        coming = self._coming
        if coming.given:
            coming.given, coming.cut, self.wrong = False, True, True
        coming.pieces.append(piece)
        if self.codec in HEADER and self._looks_whole(piece):
            coming.told = coming.told or len(coming.pieces)
            if self._right >= LEARNED and not self.wrong:
                coming.given = True
                out.append(_handed_out(coming))
        return out

    def _closed(self) -> list[Gathered]:
        """Learn from the picture that is over, and return it where it was not handed out."""
        over = self._coming
        if not over.pieces:
            return []
        if over.told:
            self._right = self._right + 1 if over.told == len(over.pieces) else 0
        self._slices[over.kind] = max(over.slices, self._slices.get(over.kind, 0))
        return [_handed_out(over)]

    def _looks_whole(self, piece: bytes) -> bool:
        """Whether a unit ends with this piece that is the last slice of a picture of its kind."""
        coming, longest = self._coming, self._longest
        if piece.startswith(START):
            longest += len(START) + HEADER[self.codec]
            for unit in filter(None, piece.split(START)):
                kind, coming.slicing, key = _unit(self.codec, unit)
                coming.key = coming.key or key
                coming.slices += coming.slicing
                if coming.slicing and coming.kind < 0:
                    coming.kind = kind
        else:
            self._longest = max(longest, len(piece))
        return coming.slicing and len(piece) < longest and coming.slices == self._slices.get(coming.kind)


def _unit(codec: str, unit: bytes) -> tuple[int, bool, bool]:
    """Type of a unit, whether it is a slice, and whether a decoder can begin with it."""
    if codec == "hevc":
        kind = unit[0] >> 1 & 0x3F
        return kind, kind < 32, 16 <= kind < 24
    kind = unit[0] & 0x1F
    # A message (6) that begins with a recovery point (6) stands for a key picture where a camera refreshes in parts.
    return kind, 1 <= kind <= 5, kind == 5 or (kind == 6 and unit[1:2] == b"\6")


def _handed_out(picture: _Coming) -> Gathered:
    data = b"".join(picture.pieces)
    picture.pieces.clear()
    return Gathered(data, picture.stamp, picture.key, picture.cut)
