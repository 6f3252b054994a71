"""Pictures from their pieces: nothing is lost or changed, and the last piece is known when it comes."""

from __future__ import annotations

import io
import itertools
from functools import cache

import av
import numpy as np
import pytest
from gsstream_capture.gathering import LEARNED, START, Gathering
from hypothesis import given, settings
from hypothesis import strategies as st
from live_rig import grey, painted

PARAMETERS = {
    "plain": ("libx264", "keyint=10:bframes=0:sliced-threads=0:threads=1"),
    "four slices": ("libx264", "keyint=10:bframes=0:slices=4"),
    "refreshed in parts": ("libx264", "keyint=10:bframes=0:intra-refresh=1"),
    "marked by delimiters": ("libx264", "keyint=10:bframes=0:aud=1"),
    "hevc": ("libx265", "keyint=10:bframes=0:log-level=none:repeat-headers=1:pools=none:frame-threads=1"),
    "slices of a length": ("libx264", "keyint=10:bframes=0:slice-max-size=900"),
}
COUNT = 40


@cache
def units(name: str) -> tuple[str, list[bytes], list[bool]]:
    """Codec, access units with four bytes before each NAL, and which of them FFmpeg's parser calls key pictures."""
    library, parameters = PARAMETERS[name]
    codec = {"libx264": "h264", "libx265": "hevc"}[library]
    draw, file = np.random.default_rng(1), io.BytesIO()
    noise = draw.integers(0, 90, (240, 320, 3))
    with av.open(file, "w", format=codec) as box:
        stream = box.add_stream(library, rate=10)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        option = "x264-params" if codec == "h264" else "x265-params"
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", option: parameters}
        for k in range(COUNT):
            picture = np.uint8(np.clip(grey(k, (320, 240)) * 0.6 + np.roll(noise, 5 * k, 1), 0, 255))
            box.mux(stream.encode(av.VideoFrame.from_ndarray(painted(picture, k), format="rgb24")))
        box.mux(stream.encode(None))
    file.seek(0)
    with av.open(file) as box:
        packets = [packet for packet in box.demux() if packet.size]
    # Three bytes before a NAL mean the same as four.
    whole = [START + START.join(_nals(bytes(packet))) for packet in packets]
    return codec, whole, [packet.is_keyframe for packet in packets]


def _nals(unit: bytes) -> list[bytes]:
    return [nal.rstrip(b"\0") for nal in unit.split(START[1:]) if nal.rstrip(b"\0")]


def pieces(codec: str, unit: bytes, longest: int) -> list[bytes]:
    """A picture as it comes through FFmpeg from senders that fill their packets: RFC 6184 and RFC 7798."""
    header, out = {"h264": 1, "hevc": 2}[codec], []
    for nal in _nals(unit):
        if len(nal) <= longest + header:
            out.append(START + nal)
            continue
        body = nal[header:]
        parts = [body[at : at + longest] for at in range(0, len(body), longest)]
        out += [START + nal[:header] + parts[0], *parts[1:]]
    return out


def gathered(codec: str, pictures: list[list[bytes]]):
    """What comes out, and for each picture how many of its pieces had come by then (0: the next had begun)."""
    gathering, out, after = Gathering(codec), [], []
    for stamp, parts in enumerate(pictures):
        for number, part in enumerate(parts):
            for one in gathering.push(part, stamp):
                out.append(one)
                after.append(number + 1 if one.stamp == stamp else 0)
    out += gathering.push(b"", None)
    return out, after


@pytest.mark.parametrize("longest", [300, 1386])
@pytest.mark.parametrize("name", PARAMETERS)
def test_pictures_are_whole_in_order_and_early(name, longest) -> None:
    codec, whole, keys = units(name)
    cut = [pieces(codec, unit, longest) for unit in whole]
    assert sum(map(len, cut)) > 2 * len(cut)
    out, after = gathered(codec, cut)
    assert [one.data for one in out] == whole
    assert [one.stamp for one in out] == list(range(COUNT))
    assert not any(one.cut for one in out)
    assert [one.key for one in out] == keys
    early = [taken == len(parts) for taken, parts in zip(after, cut, strict=False)]
    assert not any(early[:LEARNED]), "nothing is believed before it is learned"
    if name != "slices of a length":
        # A picture whose last piece is as long as the others waits for the next one.
        exact = [len(parts[-1]) == longest for parts in cut]
        assert all(one or two for one, two in zip(early[LEARNED + 5 : -1], exact[LEARNED + 5 :], strict=False))


@settings(deadline=None, max_examples=150)
@given(
    st.lists(st.lists(st.integers(1, 40), min_size=1, max_size=5), min_size=1, max_size=80),
    st.integers(3, 12),
    st.sampled_from(["h264", "hevc"]),
    st.integers(0, 60),
)
def test_nothing_is_lost_however_a_camera_cuts(slices, longest, codec, same) -> None:
    """Any number of slices of any length, after some pictures that are all alike."""
    header = b"\x41" if codec == "h264" else b"\x02\x01"
    draw = np.random.default_rng(0)

    def picture(sizes):
        return b"".join(START + header + bytes(draw.integers(1, 256, size, dtype=np.uint8)) for size in sizes)

    whole = [picture(sizes) for sizes in [[2 * longest + 1]] * same + slices]
    out, _ = gathered(codec, [pieces(codec, unit, longest) for unit in whole])
    by_stamp = {stamp: list(group) for stamp, group in itertools.groupby(out, lambda one: one.stamp)}
    assert list(by_stamp) == list(range(len(whole)))
    assert [b"".join(one.data for one in by_stamp[stamp]) for stamp in by_stamp] == whole
    told = [stamp for stamp, rows in by_stamp.items() if any(one.cut for one in rows)]
    assert all(len(rows) == 1 + (stamp in told) for stamp, rows in by_stamp.items())
    assert len(told) <= 1, "who was wrong once waits from then on"
    assert not told or told[0] >= LEARNED


def test_pictures_of_other_codecs_wait_for_the_next() -> None:
    out, after = gathered("mpeg4", [[b"abc", b"de"], [b"f"]] * 40)
    assert [one.data for one in out] == [b"abcde", b"f"] * 40
    assert set(after) == {0}


def test_pieces_without_a_stamp_are_pictures() -> None:
    gathering = Gathering("h264")
    assert [one.data for part in (b"a", b"b", b"c") for one in gathering.push(part, None)] == [b"a", b"b"]
