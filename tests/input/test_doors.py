"""Kinds of fault x doors: run, validate, prepare and watch see the same cameras, pictures and rate, or refuse alike.

The recording is a piece of the demo with four cameras; what a kind does to its files is a function of the table.
"""

from __future__ import annotations

import json
import shutil
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.storage import unpacked
from gsstream.input.prepare.given import read_raw
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.prepare.validate import validate
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from tests.input.recordings.tiny_recordings import write_video

FRAMES = 12
IDS = ("cam00", "cam01", "cam02", "cam03")
Entry = dict[str, Any]


def recording(folder: Path, edit: Callable[[Path, dict[str, Any]], None] = lambda _, __: None) -> Path:
    """Four cameras of the demo, ``FRAMES`` pictures each, as PNG; ``edit`` gets the folder and cameras.json."""
    data = json.loads((DEMO_FOLDER / "cameras.json").read_text())
    data["cameras"] = [entry for entry in data["cameras"] if entry["id"] in IDS]
    data["frames"], data["fps"] = FRAMES, 25
    data.pop("test_cameras", None)
    for entry in data["cameras"]:
        entry["split"] = "train"
        (folder / entry["id"]).mkdir(parents=True)
        for t in range(FRAMES):
            picture = Image.open(DEMO_FOLDER / (entry["frames"] % t)).convert("RGB")
            picture.save(folder / entry["id"] / f"{t:06d}.png", compress_level=1)
        entry["frames"] = f"{entry['id']}/%06d.png"
    edit(folder, data)
    (folder / "cameras.json").write_text(json.dumps(data))
    (folder / "END").touch()
    return folder


@dataclass(frozen=True)
class Seen:
    """What a door saw: cameras -> pictures [T, H, W, 3], and the rate; or why it refused."""

    pictures: dict[str, np.ndarray]
    fps: float | None
    refused: str = ""


def of_source(source: Source) -> Seen:
    ids, pictures, t = source.info.train.ids, [], 0
    while source.info.num_frames is None or t < source.info.num_frames:
        try:
            pictures.append(unpacked(source.stored_frame(t).images))
        except EndOfRecording:
            break
        t += 1
    shown = np.stack(pictures)
    return Seen({name: shown[:, c] for c, name in enumerate(ids)}, source.info.fps)


def by_run(folder: Path) -> Seen:
    return of_source(open_source(str(folder)))


def by_watch(folder: Path) -> Seen:
    return of_source(open_source(f"watch:{folder}?timeout=5"))


def by_prepare(folder: Path) -> Seen:
    raw = read_raw(str(folder))
    return Seen({camera.name: np.stack(list(camera.frames(None))) for camera in raw.cameras}, raw.fps)


def by_prepare_alone(folder: Path) -> Seen:
    """Without the calibration, which says the rate of pictures."""
    (folder / "cameras.json").rename(folder / "aside")
    try:
        cameras, fps = find_cameras(folder)
        return Seen({camera.name: np.stack(list(camera.frames(None))) for camera in cameras}, fps)
    finally:
        (folder / "aside").rename(folder / "cameras.json")


def by_validate(folder: Path) -> str:
    found = validate(lambda scale: open_source(str(folder), scale), features=False)
    return " | ".join(finding.message for finding in found if finding.severity == "error")


def asked(door: Callable[[Path], Seen], folder: Path) -> Seen:
    try:
        return door(folder)
    except SourceError as error:
        return Seen({}, None, str(error))


def renamed(name: Callable[[int], str], pattern: str) -> Callable[[Path, dict[str, Any]], None]:
    """Every picture gets the name of its number, and every camera the pattern."""

    def edit(folder: Path, data: dict[str, Any]) -> None:
        for entry in data["cameras"]:
            place = folder / entry["id"]
            for path in sorted(place.iterdir(), reverse=True):
                path.rename(place / name(int(path.stem)))
            entry["frames"] = f"{entry['id']}/{pattern}"

    return edit


def lost(*numbers: int, cameras: tuple[str, ...] = IDS) -> Callable[[Path, dict[str, Any]], None]:
    def edit(folder: Path, data: dict[str, Any]) -> None:
        for name in cameras:
            for number in numbers:
                (folder / name / f"{number:06d}.png").unlink()
        data["frames"] = FRAMES - len(numbers)

    return edit


def replaced(change: Callable[[Path], None]) -> Callable[[Path, dict[str, Any]], None]:
    """Picture 5 of cam01 is made another."""
    return lambda folder, _: change(folder / "cam01" / "000005.png")


def saved(mode: str, size: tuple[int, int] | None = None, **options: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        image = Image.open(path).convert(mode)
        (image if size is None else Image.new(mode, size)).save(path, **options)

    return change


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:900])


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(kind: bytes, before: bytes) -> Callable[[Path], None]:
    """A chunk that unpacks to 20 MB is put behind the header."""

    def change(path: Path) -> None:
        data = path.read_bytes()
        path.write_bytes(data[:33] + chunk(kind, before + zlib.compress(bytes(20_000_000), 9)) + data[33:])

    return change


def twins(folder: Path, _: dict[str, Any]) -> None:
    """What a Mac and Windows leave on the way."""
    for path in list(folder.glob("*/*.png")):
        (path.parent / f"._{path.name}").write_bytes(bytes.fromhex("0005160700020000") + b"Mac OS X" + bytes(100))
    for name in IDS:
        (folder / name / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
        (folder / f"._{name}").write_bytes(bytes(20))


def odd_ids(folder: Path, data: dict[str, Any]) -> None:
    for entry, name in zip(data["cameras"], ("Kamera 1", "カメラ", "CAM-é", "cam.4"), strict=True):
        (folder / entry["id"]).rename(folder / name)
        entry["id"], entry["frames"] = name, f"{name}/%06d.png"


def upper(folder: Path, data: dict[str, Any]) -> None:
    renamed(lambda t: f"IMG_{t:04d}.PNG", "IMG_%04d.PNG")(folder, data)


def opaque(folder: Path, _: dict[str, Any]) -> None:
    for path in folder.glob("*/*.png"):
        saved("RGBA")(path)


#: Kind -> (what is done, numbers of the demo's frames that every door delivers).
READ: dict[str, tuple[Callable[[Path, dict[str, Any]], None], list[int]]] = {
    "as it is": (lambda _, __: None, list(range(FRAMES))),
    "unpadded numbers": (renamed(lambda t: f"frame_{t + 1}.png", "frame_%d.png"), list(range(FRAMES))),
    "from 1": (renamed(lambda t: f"{t + 1:06d}.png", "%06d.png"), list(range(FRAMES))),
    "every second number": (renamed(lambda t: f"{2 * t:04d}.png", "%04d.png"), list(range(FRAMES))),
    "a common gap": (lost(3, 4), [0, 1, 2, *range(5, FRAMES)]),
    "twins of a Mac, Thumbs.db": (twins, list(range(FRAMES))),
    "blanks, letters, dots in ids": (odd_ids, list(range(FRAMES))),
    "suffixes in capitals": (upper, list(range(FRAMES))),
    "an opaque alpha channel": (opaque, list(range(FRAMES))),
}
#: Kind -> (what is done, words that every door's refusal holds).
REFUSED: dict[str, tuple[Callable[[Path, dict[str, Any]], None], tuple[str, ...]]] = {
    "a gap of one camera": (lost(3, cameras=("cam01",)), ("cam01", "frame 3 is missing")),
    "half a picture": (replaced(cut), ("000005.png", "cannot be decoded")),
    "a picture of another size": (replaced(saved("RGB", (80, 60))), ("000005.png", "80 x 60")),
    "a picture with holes": (replaced(saved("RGBA", (160, 120))), ("000005.png", "transparency")),
    "a text of 20 MB": (replaced(bomb(b"zTXt", b"k\0\0")), ("000005.png", "cannot be decoded")),
    "a profile of 20 MB": (replaced(bomb(b"iCCP", b"k\0\0")), ("000005.png", "cannot be decoded")),
}


@pytest.mark.parametrize("kind", READ)
@pytest.mark.filterwarnings("ignore")
def test_what_can_be_read_is_the_same_through_every_door(kind: str, tmp_path: Path) -> None:
    edit, numbers = READ[kind]
    folder = recording(tmp_path / "rec", edit)
    truth = open_source("demo")
    seen = {door.__name__: asked(door, folder) for door in (by_run, by_watch, by_prepare, by_prepare_alone)}
    for name, one in seen.items():
        assert one.refused == "", name
        assert sorted(one.pictures) == sorted(seen["by_run"].pictures), name
        assert one.fps == (None if name == "by_prepare_alone" else 25), name
        for place, camera in enumerate(seen["by_run"].pictures):
            expected = np.stack([truth.image(t, IDS[place]) for t in numbers])
            assert np.array_equal(one.pictures[camera], expected), (name, camera)
    assert "files" not in by_validate(folder)


@pytest.mark.parametrize("kind", REFUSED)
@pytest.mark.filterwarnings("ignore")
def test_what_cannot_be_read_is_refused_by_every_door(kind: str, tmp_path: Path) -> None:
    edit, words = REFUSED[kind]
    folder = recording(tmp_path / "rec", edit)
    for door in (by_run, by_prepare, by_prepare_alone):
        told = asked(door, folder).refused
        assert all(word in told for word in words) or "000003.png" in told, (door.__name__, told)
        assert len(told.splitlines()) == 1
    assert all(word in by_validate(folder) for word in words) or "000003.png" in by_validate(folder)
    # Whoever watches cannot know that the picture will not be mended: the recording ends there, which is said.
    with pytest.warns(UserWarning, match=r"ends after [35] frames: END was written; frame [35] is left out .*cam01"):
        assert len(by_watch(folder).pictures["cam00"]) in (3, 5)


def films(folder: Path, rates: dict[str, int], edit: Callable[[Path], None] = lambda _: None) -> Path:
    """The same cameras as lossy videos of 12 key frames."""
    pytest.importorskip("av")
    recording(folder)
    data = json.loads((folder / "cameras.json").read_text())
    del data["frames"], data["fps"]
    truth = open_source("demo")
    for entry in data["cameras"]:
        name = entry["id"]
        shutil.rmtree(folder / name)
        pictures = np.stack([np.round(truth.image(t, name) * 255).astype(np.uint8) for t in range(FRAMES)])
        entry["frames"] = f"{name}.mp4"
        write_video(folder / f"{name}.mp4", pictures, rate=rates.get(name, 25), codec="libx264", g=1, bf=0, qp=12)
    edit(folder)
    (folder / "cameras.json").write_text(json.dumps(data))
    return folder


def zeros(folder: Path) -> None:
    """Picture 3 of cam01 loses its second half."""
    import av

    path = folder / "cam01.mp4"
    with av.open(str(path)) as file:
        at, size = [(packet.pos, packet.size) for packet in file.demux(video=0) if packet.size][3]
    data = bytearray(path.read_bytes())
    data[at + size // 2 : at + size] = bytes(size - size // 2)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("rates", "edit", "words"),
    [
        ({}, lambda _: None, ()),
        ({"cam02": 50}, lambda _: None, ("different rates", "cam02 50")),
        ({}, zeros, ("cam01.mp4", "frame 3")),
        ({}, lambda f: (f / "._cam01.mp4").write_bytes(bytes(99)), ()),
    ],
    ids=["sound", "rates", "damage", "twin of a Mac"],
)
def test_videos_are_the_same_through_every_door(
    rates: dict[str, int], edit: Callable[[Path], None], words: tuple[str, ...], tmp_path: Path
) -> None:
    folder = films(tmp_path / "rec", rates, edit)
    seen = {door.__name__: asked(door, folder) for door in (by_run, by_prepare, by_prepare_alone)}
    for name, one in seen.items():
        assert bool(one.refused) == bool(words), (name, one.refused)
        assert all(word in one.refused for word in words), (name, one.refused)
        assert one.fps == (None if words else 25), name
        assert list(one.pictures) == ([] if words else list(IDS))
        for camera, pictures in one.pictures.items():
            assert np.array_equal(pictures, seen["by_run"].pictures[camera]), (name, camera)
    assert all(word in by_validate(folder) for word in words)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "I;16", "16-bit RGB"])
def test_a_huge_picture_in_place_of_a_frame_is_refused_before_it_is_decoded(mode: str, tmp_path: Path) -> None:
    """Only the header is honest: whoever decodes finds no pixels, and says so."""
    path = recording(tmp_path / "rec") / "cam01" / "000005.png"
    depth, colour = {"RGB": (8, 2), "RGBA": (8, 6), "I;16": (16, 0), "16-bit RGB": (16, 2)}[mode]
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 13_000, 13_000, depth, colour, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b""))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        told = asked(by_run, path.parents[1]).refused
    assert "000005.png: the image is 13000 x 13000 pixels, but the first image of its camera has 160 x 120" in told


def slipped(folder: Path) -> None:
    """Camera cam02 shows picture 4 and all that follow three frames late, as a phone that slows down writes it."""
    import av

    path, out = folder / "cam02.mp4", folder / "slipped.mp4"
    with av.open(str(path)) as file, av.open(str(out), "w") as copy:
        stream = copy.add_stream_from_template(file.streams.video[0])
        packets = [packet for packet in file.demux(video=0) if packet.size]
        step = packets[1].pts - packets[0].pts
        for number, packet in enumerate(packets):
            packet.pts = packet.dts = packets[0].pts + step * (number + (3 if number >= 4 else 0))
            packet.stream = stream
            copy.mux(packet)
    out.replace(path)


def test_a_variable_rate_is_told_by_every_door_and_moves_no_picture(tmp_path: Path) -> None:
    even = by_run(films(tmp_path / "even", {}))
    folder = films(tmp_path / "slipped", {}, slipped)
    told = r"cam02: time stamps are uneven: frame 4 comes \+3\.0 frames off"
    for door in (by_run, by_prepare, by_prepare_alone):
        with pytest.warns(UserWarning, match=told):
            seen = door(folder)
        assert seen.fps == 25
        assert all(np.array_equal(seen.pictures[camera], even.pictures[camera]) for camera in IDS)
    with pytest.warns(UserWarning, match=told):
        assert "files" not in by_validate(folder)
