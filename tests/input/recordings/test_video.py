"""Videos: exact frame numbers in any order, colours, depth, clocks, and damage that is told instead of patched up."""

from __future__ import annotations

import contextlib
import struct
import warnings
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_recordings import make_world, write_n3dv, write_video

from gsstream.core.errors import SourceError
from gsstream.core.storage import unpacked
from gsstream.input.recordings.clips import ImageClip, folder_clip
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.sync import RecordingWarning, align
from gsstream.input.recordings.video import VideoClip

av = pytest.importorskip("av")
SIZE = (48, 32)


def numbered(count: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Noise pictures with their number in the brightness of the left half."""
    rng = np.random.default_rng(1)
    pictures = rng.integers(0, 256, (count, size[1], size[0], 3), dtype=np.uint8)
    pictures[:, :, : size[0] // 2] = (4 * np.arange(count) + 10)[:, None, None, None]
    return pictures


def number_of(image: np.ndarray) -> int:
    return round((float(unpacked(image)[:, :20].mean()) * 255 - 10) / 4)


@contextlib.contextmanager
def names_it(path: Path, *words: str) -> Iterator[None]:
    """What follows may end in a SourceError, and then it names the file and these words."""
    try:
        yield
    except SourceError as error:
        if not all(word in str(error) for word in (str(path), *words)):
            raise AssertionError(f"the message does not name {path} and {words}") from error


def write_timed(path: Path, pictures: np.ndarray, times: list[int], base: Fraction) -> None:
    """A video with these time stamps."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=30)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt, stream.options = "rgb24", {"qp": "0", "bf": "0"}
        stream.time_base = stream.codec_context.time_base = base
        for picture, pts in zip(pictures, times, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = pts, base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.fixture(scope="module", params=["mp4 b-frames", "mkv open gop", "mp4 one key", "mp4 lossy"])
def clip(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> VideoClip:
    folder = tmp_path_factory.mktemp("video")
    options: dict[str, dict[str, Any]] = {
        "mp4 b-frames": {"bf": 3, "g": 6},
        "mkv open gop": {"bf": 3, "g": 6, "x264-params": "open-gop=1:b-adapt=0"},
        "mp4 one key": {"bf": 2, "g": 1000},
        "mp4 lossy": {"codec": "libx264", "bf": 3, "g": 7, "qp": 20},
    }
    path = folder / f"clip.{request.param[:3]}"
    write_video(path, numbered(40), **options[request.param])
    return VideoClip(path)


@given(st.lists(st.integers(0, 39), min_size=1, max_size=12))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_order_gives_the_picture_of_that_number(clip: VideoClip, order: list[int]) -> None:
    assert clip.num_frames == 40
    assert clip.fps == pytest.approx(30)
    for index in order:
        assert number_of(clip.read(index, SIZE)) == index


def test_the_same_bits_in_order_backwards_and_after_closing(clip: VideoClip) -> None:
    forwards = [clip.read(i, SIZE).tobytes() for i in range(40)]
    backwards = [clip.read(i, SIZE).tobytes() for i in reversed(range(40))]
    clip.close()
    assert backwards[::-1] == forwards
    assert clip.read(17, SIZE).tobytes() == forwards[17]


def test_lossless_video_is_exact_and_shrinks_like_images(tmp_path: Path) -> None:
    pictures = numbered(3)
    write_video(tmp_path / "a.mp4", pictures)
    clip = VideoClip(tmp_path / "a.mp4")
    np.testing.assert_array_equal(clip.read(1, SIZE), pictures[1])
    assert clip.read(1, SIZE).dtype == np.uint8
    blocks = pictures[1].reshape(16, 2, 24, 2, 3).mean((1, 3)) / 255
    np.testing.assert_allclose(clip.read(1, (24, 16)), blocks, atol=1e-6)


@pytest.mark.parametrize(("space", "bt709"), [("bt709", True), ("smpte170m", False)])
def test_the_colour_matrix_of_the_file_is_honoured(tmp_path: Path, space: str, bt709: bool) -> None:
    """Y, Cb, Cr are written by hand, and read back by the standard's formulas."""
    y, cb, cr = 120, 90, 160
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = {"qp": "0", "x264-params": f"colormatrix={space}:colorprim={space}:transfer={space}"}
        planes = [np.full((32, 48), y), np.full((8, 48), cb), np.full((8, 48), cr)]
        frame = av.VideoFrame.from_ndarray(np.concatenate(planes).astype(np.uint8), format="yuv420p")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    kr, kb = (0.2126, 0.0722) if bt709 else (0.299, 0.114)
    light, blue, red = (y - 16) / 219, (cb - 128) / 224, (cr - 128) / 224
    r, b = light + 2 * (1 - kr) * red, light + 2 * (1 - kb) * blue
    g = (light - kr * r - kb * b) / (1 - kr - kb)
    image = unpacked(VideoClip(tmp_path / "a.mp4").read(0, SIZE))
    np.testing.assert_allclose(image[16, 24], [r, g, b], atol=2.5 / 255)


def test_ten_bit_video_keeps_its_low_bits(tmp_path: Path) -> None:
    levels = np.linspace(0, 1023, 48).astype(np.uint16)
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "gbrp10le"
        picture = np.repeat(np.repeat(levels[None, :, None], 32, 0), 3, 2)
        wide = (picture.astype(np.uint32) * 65535 // 1023).astype(np.uint16)
        frame = av.VideoFrame.from_ndarray(wide, format="rgb48le").reformat(format="gbrp10le")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    clip = VideoClip(tmp_path / "a.mkv")
    image = clip.read(0, SIZE)
    assert clip.deep
    assert len(np.unique(image[0, :, 0])) == 48
    np.testing.assert_allclose(image[0, :, 0], levels / 1023, atol=1.1 / 1023)


def test_variable_rates_are_counted_and_told(tmp_path: Path) -> None:
    times = [0, 1, 2, 3, 7, 8, 9, 10]  # three frames dropped after the fourth
    write_timed(tmp_path / "cam00.mp4", numbered(8), times, Fraction(1, 30))
    write_timed(tmp_path / "cam01.mp4", numbered(8), list(range(8)), Fraction(1, 30))
    clips = {name: VideoClip(tmp_path / f"{name}.mp4") for name in ("cam00", "cam01")}
    assert clips["cam00"].num_frames == 8
    assert [number_of(clips["cam00"].read(i, SIZE)) for i in (6, 2, 4)] == [6, 2, 4]
    with pytest.warns(RecordingWarning, match=r"cam00: time stamps are uneven: frame 4 comes \+3\.0 frames off"):
        align("r", clips)


def test_different_rates_are_refused_with_numbers_and_ntsc_is_not(tmp_path: Path) -> None:
    write_timed(tmp_path / "cam00.mp4", numbered(12), list(range(12)), Fraction(1, 30))
    write_timed(tmp_path / "cam01.mp4", numbered(12), list(range(12)), Fraction(1, 25))
    write_timed(tmp_path / "cam02.mp4", numbered(12), list(range(12)), Fraction(1001, 30000))
    clips = {name: VideoClip(tmp_path / f"{name}.mp4") for name in ("cam00", "cam01", "cam02")}
    with pytest.raises(SourceError, match=r"different rates .*cam00 30, cam01 25.*drift by 2\.4 frames over 12"):
        align("r", {name: clips[name] for name in ("cam00", "cam01")})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert align("r", {name: clips[name] for name in ("cam00", "cam02")}).num_frames == 12


def test_late_starts_and_unequal_lengths_are_told_with_the_setting_that_mends_them(tmp_path: Path) -> None:
    write_timed(tmp_path / "cam00.mkv", numbered(8), list(range(8)), Fraction(1, 30))
    write_timed(tmp_path / "cam01.mkv", numbered(6), list(range(3, 9)), Fraction(1, 30))
    clips = {name: VideoClip(tmp_path / f"{name}.mkv") for name in ("cam00", "cam01")}
    with pytest.warns(RecordingWarning) as told:
        assert align("r", clips).num_frames == 6
    text = " | ".join(str(w.message) for w in told)
    assert "cameras differ in their frames (cam00 8 from 0); the 6 common ones are used" in text
    assert "the span is that of cam01" in text, "the short one is named"
    assert "frames: cam01 3.0" in text
    assert "--source disturbed:time_offset=cam01@-3:SOURCE" in text


def test_numbered_images_are_laid_beside_each_other_by_number(tmp_path: Path) -> None:
    from tiny_recordings import write_frames

    write_frames(tmp_path / "a", numbered(6), first=10)
    write_frames(tmp_path / "b", numbered(6)[2:], first=12)
    clips = {"a": folder_clip(tmp_path / "a"), "b": folder_clip(tmp_path / "b")}
    with pytest.warns(RecordingWarning, match=r"a 6 from 10\); the 4 common ones are used, from number 12"):
        found = align("r", clips)
    assert (found.num_frames, dict(found.skip)) == (4, {"a": 2, "b": 0})
    (tmp_path / "b" / "0013.png").unlink()
    with pytest.raises(SourceError, match=r"b: camera 'b': frame 13 is missing \(1 of 4 are\)"):
        align("r", {"a": folder_clip(tmp_path / "a"), "b": folder_clip(tmp_path / "b")})
    (tmp_path / "a" / "0013.png").unlink()
    with pytest.warns(RecordingWarning, match="no camera has a frame between the numbers 12 and 14"):
        found = align("r", {"a": folder_clip(tmp_path / "a"), "b": folder_clip(tmp_path / "b")})
    assert (found.num_frames, dict(found.skip)) == (3, {"a": 2, "b": 0})
    with pytest.raises(SourceError, match="no frame number is common"):
        align("r", {"a": folder_clip(tmp_path / "a"), "b": ImageClip([tmp_path / "a" / "0010.png"], [90])})


def test_a_cut_video_is_read_up_to_the_cut_or_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "whole.mkv", numbered(40))
    data = (tmp_path / "whole.mkv").read_bytes()
    for share in (0.0, 0.02, 0.5, 0.9):
        path = tmp_path / "cut.mkv"
        path.write_bytes(data[: int(share * len(data))])
        with names_it(path):
            clip = VideoClip(path)
            for index in range(clip.num_frames):
                with names_it(path, f"frame {index}"):
                    assert number_of(clip.read(index, SIZE)) == index


@given(st.integers(0, 2**32), st.floats(0.2, 0.95))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_an_error_or_harmless(tmp_path: Path, seed: int, share: float) -> None:
    """Bytes overwritten in the middle: whatever is returned is a picture of the right size, else one clear message."""
    path = tmp_path / "broken.mp4"
    write_video(path, numbered(8))
    data = bytearray(path.read_bytes())
    at = int(share * len(data))
    data[at : at + 40] = np.random.default_rng(seed).integers(0, 256, 40, dtype=np.uint8).tobytes()
    path.write_bytes(bytes(data))
    with names_it(path):
        clip = VideoClip(path)
        for index in range(clip.num_frames):
            assert clip.read(index, clip.size).shape == (clip.size[1], clip.size[0], 3)


def test_text_is_not_a_video(tmp_path: Path) -> None:
    (tmp_path / "cam00.mp4").write_text("hello")
    with pytest.raises(SourceError, match=r"cam00\.mp4: the video cannot be opened .*cut or damaged"):
        VideoClip(tmp_path / "cam00.mp4")


def test_a_rig_of_videos_from_many_threads(tmp_path: Path) -> None:
    """The prefetcher may read with several threads: pictures stay those of their number."""
    from gsstream.input.recordings.prefetch import Prefetcher

    world = make_world(frames=6)
    source = open_source(str(write_n3dv(tmp_path / "scene", world)))
    with Prefetcher(source, [5, 0, 3, 3, 1, 4, 2], depth=7, workers=4) as frames:
        for train, test in frames:
            np.testing.assert_array_equal(np.round(train.images * 255), world.pictures[train.index, 1:])
            np.testing.assert_array_equal(np.round(test.images * 255), world.pictures[test.index, :1])


ONE = 1 << 16
#: Display matrix (a, b, c, d) of a track, which shows what lies at x, y at a x + c y, b x + d y -> pictures as shown.
SHOWN = {
    (1, 0, 0, 1): lambda p: p,
    (0, 1, -1, 0): lambda p: np.rot90(p, -1, axes=(1, 2)),
    (-1, 0, 0, -1): lambda p: np.rot90(p, 2, axes=(1, 2)),
    (0, -1, 1, 0): lambda p: np.rot90(p, 1, axes=(1, 2)),
    (-1, 0, 0, 1): lambda p: p[:, :, ::-1],
    (1, 0, 0, -1): lambda p: p[:, ::-1],
    (0, 1, 1, 0): lambda p: p.transpose(0, 2, 1, 3),
    (0, -1, -1, 0): lambda p: p[:, ::-1, ::-1].transpose(0, 2, 1, 3),
}


def set_display_matrix(path: Path, a: int, b: int, c: int, d: int) -> None:
    """Overwrite the matrix in the track header of an MP4 (version 0)."""
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 4 + 20 + 16
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize("matrix", SHOWN)
def test_a_film_comes_as_its_display_matrix_says(matrix: tuple[int, int, int, int], tmp_path: Path) -> None:
    """Turned phones and selfie cameras: four turns, and the mirror image of each."""
    stored = numbered(3)
    for camera in ("a", "b"):
        write_video(tmp_path / f"{camera}.mp4", stored)
        set_display_matrix(tmp_path / f"{camera}.mp4", *(ONE * number for number in matrix))
    expected = SHOWN[matrix](stored)
    clip = VideoClip(tmp_path / "b.mp4")
    assert clip.size == (expected.shape[2], expected.shape[1])
    for index in (2, 0, 1):
        assert np.array_equal(clip.read(index, clip.size), expected[index])
    with av.open(str(tmp_path / "b.mp4")) as container:
        told = next(container.decode(video=0)).rotation
    if matrix[0] * matrix[3] - matrix[1] * matrix[2] > 0:
        assert np.array_equal(expected, np.rot90(stored, told // 90, axes=(1, 2))), "as the library has it"


def test_a_film_turned_by_a_crooked_angle_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "x.mp4", numbered(2))
    set_display_matrix(tmp_path / "x.mp4", 46341, 46341, -46341, 46341)
    with pytest.raises(SourceError, match=r"x\.mp4: the file says to turn .* multiple of 90"):
        VideoClip(tmp_path / "x.mp4")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_cover_picture_is_no_film(suffix: str, tmp_path: Path) -> None:
    """Drones and tagged files put one picture in front of the film, as a stream of its own."""
    pictures = numbered(6)
    with av.open(str(tmp_path / f"a.{suffix}"), "w") as container:
        cover, film = container.add_stream("mjpeg", rate=30), container.add_stream("libx264rgb", rate=30)
        for stream, kind in ((cover, "yuvj420p"), (film, "rgb24")):
            stream.width, stream.height, stream.pix_fmt = *SIZE, kind
        film.options = {"qp": "0"}
        if suffix == "mkv":
            cover.disposition = av.stream.Disposition.attached_pic
        for stream, shown in ((cover, pictures[:1]), (film, pictures)):
            for picture in shown:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    clip = VideoClip(tmp_path / f"a.{suffix}")
    assert (clip.num_frames, clip.doubts) == (6, ())
    assert [number_of(clip.read(i, SIZE)) for i in (5, 0, 3)] == [5, 0, 3]


@pytest.mark.parametrize("hidden", [1, 5, 8])
def test_a_film_cut_without_reencoding_begins_at_the_cut(hidden: int, tmp_path: Path) -> None:
    """An edit list hides the pictures between a key frame and the cut; groups of 6 with B-frames."""
    write_video(tmp_path / "whole.mp4", numbered(16), g=6, bf=2)
    cut = {"avoid_negative_ts": "disabled"}
    with av.open(str(tmp_path / "whole.mp4")) as old, av.open(str(tmp_path / "cut.mp4"), "w", options=cut) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        step = int(1 / 30 / old.streams.video[0].time_base)
        for packet in old.demux(video=0):
            if packet.dts is not None:
                packet.pts, packet.dts, packet.stream = packet.pts - hidden * step, packet.dts - hidden * step, stream
                new.mux(packet)
    clip = VideoClip(tmp_path / "cut.mp4")
    assert clip.num_frames == 16 - hidden
    order = [*range(clip.num_frames), *reversed(range(clip.num_frames)), 3, 0, 5]
    assert [number_of(clip.read(i, SIZE)) - hidden for i in order] == order


@pytest.mark.parametrize(("curve", "told"), [("smpte2084", "PQ"), ("arib-std-b67", "HLG"), ("bt709", "")])
def test_high_dynamic_range_is_said_with_its_cure(curve: str, told: str, tmp_path: Path) -> None:
    for name in "ab":
        path = tmp_path / f"{name}.mp4"
        write_video(path, numbered(3), codec="libx264", qp=10, **{"x264-params": f"transfer={curve}"})
    clips = {name: VideoClip(tmp_path / f"{name}.mp4") for name in "ab"}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        align("r", clips)
    text = [str(warning.message) for warning in caught]
    assert len(text) == bool(told), "once for all cameras"
    assert all(f"a, b: high dynamic range ({told})" in line and "BT.709" in line for line in text)


def test_interlaced_films_are_said_with_their_cure(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", numbered(4), codec="libx264", qp=10, flags="+ildct+ilme")
    with pytest.warns(RecordingWarning, match="a: interlaced pictures, which comb .*bwdif"):
        align("r", {"a": VideoClip(tmp_path / "a.mp4")})
