"""Films as phones and cameras of television write them: high dynamic range, interlaced, ten bits and more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.storage import unpacked
from gsstream.input.recordings.clips import clips_in
from gsstream.input.recordings.sync import align
from gsstream.input.recordings.video import VideoClip

av = pytest.importorskip("av")
WIDTH, HEIGHT, FRAMES = 96, 64, 6
#: Numbers of ITU-T H.273: BT.709; BT.2020 with the curve of HLG, and with PQ.
BT709, HLG, PQ = (1, 1, 1), (9, 18, 9), (9, 16, 9)
X265 = {"x265-params": "log-level=none:crf=8"}
FIELDS = {"flags": "+ildct+ilme"}
#: Who writes so -> (suffix, codec, pixel format, (primaries, transfer, matrix), options, what is said).
FILMS: dict[str, tuple[str, str, str, tuple[int, int, int], dict[str, str], str]] = {
    "a phone, HLG": ("mov", "libx265", "yuv420p10le", HLG, X265, r"high dynamic range \(HLG\)"),
    "a phone, HDR10": ("mp4", "libx265", "yuv420p10le", PQ, X265, r"high dynamic range \(PQ\)"),
    "ProRes, HLG": ("mov", "prores_ks", "yuv422p10le", HLG, {"profile": "3"}, r"high dynamic range \(HLG\)"),
    "ProRes": ("mov", "prores_ks", "yuv422p10le", BT709, {"profile": "3"}, ""),
    "ProRes, fields": ("mov", "prores_ks", "yuv422p10le", BT709, {"profile": "3", "flags": "+ildct"}, "interlaced"),
    "a tape, MPEG-2": ("ts", "mpeg2video", "yuv420p", BT709, {**FIELDS, "b": "5M"}, "interlaced"),
    "AVCHD": ("mp4", "libx264", "yuv420p", BT709, {**FIELDS, "crf": "8"}, "interlaced"),
    "an archive": ("mkv", "ffv1", "yuv444p16le", BT709, {}, ""),
}


def moving_bar() -> np.ndarray:
    """[T, H, W, 3] uint16: a bright bar that goes to the right, on a green ramp."""
    pictures = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint16)
    pictures[..., 1] += np.linspace(0, 5000, WIDTH).astype(np.uint16)
    for t, picture in enumerate(pictures):
        picture[:, 8 * t : 8 * t + 16] = 60_000
    return pictures


def write(path: Path, codec: str, layout: str, tags: tuple[int, int, int], options: dict[str, str]) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this build of PyAV has no {codec}")
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.options = WIDTH, HEIGHT, layout, options
        for of in (stream.codec_context,):
            of.color_primaries, of.color_trc, of.colorspace = tags
        for picture in moving_bar():
            frame = av.VideoFrame.from_ndarray(picture, format="rgb48le").reformat(
                format=layout, dst_colorspace=tags[2]
            )
            frame.color_primaries, frame.color_trc, frame.colorspace = tags
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("name", FILMS)
def test_a_film_is_read_and_what_it_lacks_is_said(name: str, tmp_path: Path) -> None:
    suffix, codec, layout, tags, options, told = FILMS[name]
    for camera in ("cam_0", "cam_1"):
        write(tmp_path / f"{camera}.{suffix}", codec, layout, tags, options)
    clips = clips_in([tmp_path])
    clip = clips["cam_0"]
    assert isinstance(clip, VideoClip)
    assert (clip.num_frames, round(clip.fps, 3)) == (FRAMES, 30)
    assert clip.deep == ("p10" in layout or "p16" in layout)
    for t, picture in enumerate(moving_bar()):
        off = np.abs(unpacked(clip.read(t, clip.size)) - picture / 65_535)
        assert off.mean() < 0.01, f"frame {t}: another picture, or another matrix of colours"
    if told:
        with pytest.warns(UserWarning, match=f"cam_0, cam_1: {told}"):
            align("films", clips)
    else:
        assert clip.doubts == ()
