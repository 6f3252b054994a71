"""What a source promises, checked on a recording that it opens."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.shapes import FloatArray, check_finite, check_shape
from gsstream.core.storage import packed
from gsstream.input.recordings.base import Moment, Source, Split, Wrapped
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.transformed import transformed
from gsstream.testing.registry import SourceUnderTest, check

SPLITS: tuple[Split, ...] = ("train", "test")
THREADS = 4


def _some(source: Source) -> list[int]:
    """First, second and last frame; of a recording that grows the first alone, because others may be waited for."""
    number = source.info.num_frames
    return [0] if number is None else sorted({0, min(1, number - 1), number - 1})


def _rig(source: Source, split: Split) -> Cameras:
    return source.info.train if split == "train" else source.info.test


def _same_images(what: str, got: Frame, expected: Frame) -> None:
    assert got.images.shape == expected.images.shape, (
        f"{what}: frame {got.index}: expected shape {expected.images.shape}, got {got.images.shape}"
    )
    wrong = got.images != expected.images
    first = tuple(np.argwhere(wrong)[0].tolist()) if wrong.any() else ()
    assert not first, f"{what}: frame {got.index}: {int(wrong.sum())} of {wrong.size} values differ, first at {first}"


@check("source")
def check_source_info(subject: SourceUnderTest) -> None:
    """It has a name, a frame rate, frames, at least one training camera, and no camera in both splits."""
    with subject.open() as source:
        assert isinstance(source, Source), f"expected a subclass of gsstream.api.Source, got {type(source).__name__}"
        info = source.info
    assert info.name, "info.name is empty"
    assert np.isfinite(info.fps) and info.fps > 0, f"info.fps: expected frames per second, got {info.fps}"
    assert info.num_frames is None or info.num_frames >= 1, f"info.num_frames: expected >= 1, got {info.num_frames}"
    assert len(info.train) >= 1, "info.train: expected at least one camera"
    for rig in (info.train, info.test):
        rig.validate()
    both = set(info.train.ids) & set(info.test.ids)
    assert not both, f"cameras both trained on and tested with: {', '.join(sorted(both))}"


@check("source")
def check_source_frames(subject: SourceUnderTest) -> None:
    """Images are [C, H, W, 3] float32 in [0, 1] of the cameras of the split, in their order; time goes on from 0."""
    with subject.open() as source:
        for split in SPLITS:
            rig, last = _rig(source, split), -1.0
            for index in _some(source):
                frame = source.frame(index, split)
                where = f"frame {index}, {split}"
                assert frame.index == index, f"{where}: says that it is frame {frame.index}"
                assert frame.cameras.ids == rig.ids, f"{where}: expected cameras {rig.ids}, got {frame.cameras.ids}"
                same = np.array_equal(frame.cameras.viewmats, rig.viewmats) and np.array_equal(frame.cameras.Ks, rig.Ks)
                assert same, f"{where}: poses or intrinsics are not those of info.{split}"
                frame.validate()
                low, high = (float(f(frame.images)) if frame.images.size else 0.0 for f in (np.min, np.max))
                assert frame.images.dtype == np.float32 and low >= 0 and high <= 1, (
                    f"{where}: expected float32 in [0, 1], got {frame.images.dtype} from {low:g} to {high:g}"
                )
                assert frame.timestamp > last and (index > 0 or frame.timestamp == 0), (
                    f"{where}: timestamp {frame.timestamp} s; expected 0 at frame 0, then growing"
                )
                last = frame.timestamp


@check("source")
def check_source_repeatable(subject: SourceUnderTest) -> None:
    """Reading a frame again, in another order or from a second opening, gives the same bits."""
    with subject.open() as source, subject.open() as other:
        frames = [source.frame(index, split) for split in SPLITS for index in _some(source)]
        again = [source.frame(index, split) for split in reversed(SPLITS) for index in reversed(_some(source))][::-1]
        anew = [other.frame(index, split) for split in SPLITS for index in _some(source)]
    for first, second, third in zip(frames, again, anew, strict=True):
        _same_images("read again", second, first)
        _same_images("opened again", third, first)


@check("source")
def check_source_own_images(subject: SourceUnderTest) -> None:
    """A returned array belongs to the caller: changing it changes no later reading."""
    with subject.open() as source:
        first = source.frame(0)
        kept = first.images.copy()
        if first.images.flags.writeable:
            first.images[...] = 0.123
        _same_images("after somebody wrote into what was returned", source.frame(0), Frame(0, 0.0, kept, first.cameras))


@check("source")
def check_source_threads(subject: SourceUnderTest) -> None:
    """Read from four threads at once it gives the same bits: frames are read ahead by another thread."""
    with subject.open() as source:
        wanted: list[tuple[int, Split]] = [(index, split) for split in SPLITS for index in _some(source)] * 2
        alone = [source.frame(*item) for item in wanted]
        with ThreadPoolExecutor(THREADS) as pool:
            together = list(pool.map(lambda item: source.frame(*item), wanted))
    for got, expected in zip(together, alone, strict=True):
        _same_images("four threads", got, expected)


@check("source")
def check_source_goes_on(subject: SourceUnderTest) -> None:
    """Told that a run goes on, it reads the frames that were encoded before as it has read them."""
    with subject.open() as source:
        seen = [source.frame(index) for index in _some(source)]
        last = max(frame.index for frame in seen)
        source.go_on_at(last + 1, {frame.index: Moment(frame.epoch_scale, frame.arrival) for frame in seen})
        for frame in seen:
            _same_images("after go_on_at", source.frame(frame.index), frame)


@check("source")
def check_source_bounds(subject: SourceUnderTest) -> None:
    """Frames that it has not are refused by SourceError that names them."""
    with subject.open() as source:
        number = source.info.num_frames
        for index in (-1, *(() if number is None else (number, number + 1000))):
            try:
                source.frame(index)
            except SourceError as error:
                assert str(abs(index)) in str(error), f"the error does not name frame {index}: {error}"
                continue
            raise AssertionError(f"frame {index} was read; expected SourceError, there are {number} frames")


@check("source")
def check_source_points(subject: SourceUnderTest) -> None:
    """Points are [P, 3] finite, colours [P, 3] in [0, 1], at least one of each, the same twice; or there are none."""
    with subject.open() as source:
        pairs: list[tuple[PointCloud | None, PointCloud | None]] = [
            (source.points(kind), source.points(kind)) for kind in ("recording", "sparse")
        ]
    for cloud, again in pairs:
        if cloud is None:
            assert again is None, "points were None at first, and not None the second time"
            continue
        n = len(cloud)
        assert n > 0, "no points: expected None where a recording has none"
        check_shape("points.xyz", cloud.xyz, (n, 3))
        check_shape("points.rgb", cloud.rgb, (n, 3))
        check_finite("points.xyz", cloud.xyz)
        low, high = float(cloud.rgb.min()), float(cloud.rgb.max())
        assert low >= 0 and high <= 1, f"points.rgb: expected [0, 1], got {low:g} to {high:g}"
        assert again is not None and np.array_equal(cloud.xyz, again.xyz), "other points the second time"


@check("source")
def check_source_scale(subject: SourceUnderTest) -> None:
    """At scale 0.5 images and intrinsics halve together and poses stay; or the scale is refused by name."""
    with subject.open() as whole:
        full = whole.info.train
    try:
        with subject.open(0.5) as half:
            small, images = half.info.train, half.frame(0).images
    except SourceError as error:
        assert "scale" in str(error), f"refused without naming the scale: {error}"
        return
    size = (round(full.width / 2), round(full.height / 2))
    near = all(abs(a - b) <= 1 for a, b in zip((small.width, small.height), size, strict=True))
    assert near, f"scale 0.5 of {full.width} x {full.height}: expected {size}, got {small.width} x {small.height}"
    check_shape("images at scale 0.5", images, (len(small), small.height, small.width, 3))
    want = full.scaled(small.width, small.height).Ks
    off = float(np.abs(small.Ks - want).max())
    assert off <= 1e-6 * full.width, f"intrinsics at scale 0.5 are off by {off:.3g} pixels; expected K scaled exactly"
    assert np.array_equal(small.viewmats, full.viewmats), "poses changed with the scale"


@check("source")
def check_source_single_images(subject: SourceUnderTest) -> None:
    """One camera's image has the bits that it has in the frame; under every split and in a run's coordinates, too."""
    with subject.open() as opened:
        for what, source in _wrapped(opened):
            for split in SPLITS:
                frame = source.frame(0, split)
                for place, camera in enumerate(frame.cameras.ids):
                    where = f"{what}: camera {camera!r}"
                    single = source.image(0, camera)
                    assert np.array_equal(single, frame.images[place]), f"{where}: not the image of the frame"


@check("source")
def check_source_stored_images(subject: SourceUnderTest) -> None:
    """Stored images are the images as bytes where bytes hold them, always where ``stores_bytes`` says so.

    Under every split and in a run's coordinates, too.
    """
    with subject.open() as opened:
        for what, source in _wrapped(opened):
            for split in SPLITS:
                frame, stored = source.frame(0, split), source.stored_frame(0, split)
                for camera in frame.cameras.ids:
                    _same_stored(f"{what}: camera {camera!r}", source.stored_image(0, camera), source.image(0, camera))
                _same_stored(f"{what}: frame 0, {split}", stored.images, frame.images)
                assert stored.images.dtype == np.uint8 or not source.stores_bytes, (
                    f"{what}: frame 0, {split}: stores_bytes is true, expected uint8, got {stored.images.dtype}"
                )
                same = (stored.cameras.ids, stored.epoch_scale) == (frame.cameras.ids, frame.epoch_scale)
                assert same, f"{what}: frame 0, {split}: the stored frame differs in more than its images"


@check("source")
def check_source_wrapped(subject: SourceUnderTest) -> None:
    """A wrapped source answers as the source itself does, under every split and in a run's coordinates."""
    own = {name for name in vars(Source) if not name.startswith("_")}
    assert not own - set(vars(Wrapped)), f"Wrapped does not forward {', '.join(sorted(own - set(vars(Wrapped))))}"
    with subject.open() as opened:
        for what, source in _wrapped(opened):
            for name in ("stores_bytes", "epoch_scale", "moment", "waiting"):
                answers = [getattr(one, name) for one in (source, opened)]
                wrapped, plain = (answer(0) if callable(answer) else answer for answer in answers)
                assert wrapped == plain, f"{what}: {name}: expected {plain}, got {wrapped}"
            held_out = opened.points_without((*opened.info.test.ids, *source.info.test.ids))
            for cloud in (source.points(), source.points_without(source.info.test.ids)):
                got, expected = (0 if points is None else len(points) for points in (cloud, held_out))
                assert got <= expected, f"{what}: {got} points, only {expected} of them without its test cameras"
            source.interrupt()


def _wrapped(source: Source) -> Iterator[tuple[str, Source]]:
    """The source as it is opened, and as runs with the options of ``data`` see it."""
    yield "as opened", source
    ids = source.info.train.ids
    splits: dict[str, dict[str, Any]] = {"the recording's own split": {}}
    if len(ids) > 1:
        splits |= {f"test_cameras=[{ids[0]}]": {"test_cameras": ids[:1]}, "split=tuning": {"split": "tuning"}}
        splits |= {"train_views=2": {"train_views": 2}}
    world = recording_similarity(source)
    for what, options in splits.items():
        yield what, CanonicalSource(transformed(source, DataOptions(**options)), world)


def _same_stored(where: str, stored: Any, image: FloatArray) -> None:
    expected = packed(image)
    assert stored.dtype == expected.dtype, f"{where}: expected {expected.dtype} where it is stored, got {stored.dtype}"
    assert np.array_equal(stored, expected), f"{where}: another image where it is stored"
