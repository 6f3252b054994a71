"""Kinds of fault x readers: each cell is made, read through every door, and compared with the sound recording.

``python -m tests.input.faults.table`` writes what comes out to ``cells.json``, of which docs/reference/scene-faults.md
is made.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.storage import unpacked
from gsstream.input.prepare.given import read_raw
from gsstream.input.prepare.validate import validate
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.detect import detect
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.open import open_source, read_layout
from gsstream.input.recordings.recorded import Recording
from gsstream.input.recordings.sync import RecordingWarning
from tests.input.faults.readers import FISHEYE, FRAMES, RATE, READERS, Edit, Reader
from tests.input.recordings.tiny_recordings import write_png, write_video

CELLS = Path(__file__).parent / "cells.json"
#: Sound recordings, until the process ends.
SOUND = tempfile.TemporaryDirectory(prefix="sound-")
#: What ``scene validate`` calls a recording that cannot be read.
UNREADABLE = ("calibration", "files", "images")


@dataclass(frozen=True)
class Answer:
    """What one door says: ``refused`` and ``told`` are words, ``pictures`` [T, H, W, 3] of each camera."""

    refused: str = ""
    told: frozenset[str] = frozenset()
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    poses: dict[str, np.ndarray] = field(default_factory=dict)
    fps: float | None = None


def asked(door: Callable[[], Answer], folder: Path) -> Answer:
    """The answer with what is warned of; paths are left out of the words."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            answer = door()
        except SourceError as error:
            answer = Answer(refused=plain(str(error), folder))
    told = (plain(str(one.message), folder) for one in caught if issubclass(one.category, RecordingWarning))
    return replace(answer, told=frozenset(told))


def plain(words: str, folder: Path) -> str:
    return words.replace(f"{folder}/", "").replace(str(folder), "DIR").replace(f"{folder.name!r}", "'NAME'")


def of_source(source: Source) -> Answer:
    rig = source.info.train.joined(source.info.test)
    shown: dict[str, list[np.ndarray]] = {name: [] for name in rig.ids}
    for t in range(source.info.num_frames or FRAMES):
        try:
            for split in ("train", "test"):
                frame = source.stored_frame(t, split)  # type: ignore[arg-type]
                for name, image in zip(frame.cameras.ids, frame.images, strict=True):
                    shown[name].append(unpacked(image))
        except EndOfRecording:
            break
    source.close()
    poses = dict(zip(rig.ids, rig.viewmats, strict=True))
    return Answer(pictures={name: np.stack(p) for name, p in shown.items()}, poses=poses, fps=source.info.fps)


def of_prepare(uri: str) -> Answer:
    raw = read_raw(uri)
    pictures = {camera.name: np.stack(list(camera.frames(None))) for camera in raw.cameras}
    poses = {} if raw.known is None else dict(zip(pictures, raw.known.viewmats, strict=True))
    return Answer(pictures=pictures, poses=poses, fps=raw.fps)


def of_validate(uri: str) -> Answer:
    found = validate(lambda scale: open_source(uri, scale), features=False, frames=FRAMES)
    unreadable = [one.message for one in found if one.severity == "error" and one.code in UNREADABLE]
    if unreadable:
        raise SourceError(unreadable[0])
    return Answer()


def answers(reader: Reader, folder: Path) -> dict[str, Answer]:
    """Door -> what it says; those that a reader's recordings can come in by."""
    uri = f"{reader.scheme}:{folder}" if reader.scheme not in ("", "raw") else str(folder)
    doors: dict[str, Callable[[], Answer]] = {"prepare": lambda: of_prepare(uri)}
    if reader.scheme != "raw":
        doors |= {"run": lambda: of_source(open_source(uri)), "validate": lambda: of_validate(uri)}
    if reader.file == "cameras.json" and not reader.films:
        doors["watch"] = lambda: of_source(open_source(f"watch:{folder}?timeout=2"))
    return {name: asked(door, folder) for name, door in doors.items()}


@cache
def written(name: str) -> Path:
    """The folder of the sound recording; written once, since compressing its pictures is most of what a cell costs."""
    folder = Path(SOUND.name) / str(list(READERS).index(name))
    folder.mkdir()
    READERS[name].write(folder)
    return folder


@cache
def sound(name: str) -> dict[str, Answer]:
    with tempfile.TemporaryDirectory() as place:
        return answers(READERS[name], shutil.copytree(written(name), Path(place) / "scene"))


# faults ------------------------------------------------------------------------------------------------------


def renamed(name: Callable[[int], str], suffix: str = "") -> Callable[[Reader], Edit | str]:
    """The numbers of all pictures become others, in the calibration, too, where it names them."""

    def of(reader: Reader) -> Edit | str:
        if reader.films:
            return "videos have no numbers"
        if reader.at.startswith("frame") and suffix:
            return "the number is that of a folder"

        def edit(folder: Path) -> None:
            names: dict[str, str | None] = {}
            for camera in reader.cameras:
                for t in range(FRAMES):
                    old = reader.path(folder, camera, t)
                    new = folder / renumbered(reader, camera, t, name(t))
                    new.parent.mkdir(exist_ok=True)
                    old.rename(new.with_name(f"~{new.name}"))
                    names[str(old.relative_to(folder))] = str(new.relative_to(folder))
                    if not any(old.parent.iterdir()):
                        old.parent.rmdir()
            for path in sorted(folder.rglob("~*")):
                path.rename(path.with_name(path.name[1:]))
            reader.relist(folder, names)

        return edit

    return of


def renumbered(reader: Reader, camera: str, t: int, number: str) -> str:
    """The path of a picture with another number."""
    if reader.at.startswith("frame"):
        return f"frame{number.lstrip('frame_')}/{camera}.png"
    place = str(Path(reader.at).parent).format(c=camera)
    return f"{place}/{number}.png"


def lost(cameras: int) -> Callable[[Reader], Edit | str]:
    """Picture 5 of one camera, or of all, is gone."""

    def of(reader: Reader) -> Edit | str:
        if reader.films:
            return "videos are counted"

        def edit(folder: Path) -> None:
            gone: dict[str, str | None] = {}
            for camera in reader.cameras[1 : cameras + 1] if cameras == 1 else reader.cameras:
                path = reader.path(folder, camera, 5)
                path.unlink()
                gone[str(path.relative_to(folder))] = None
                if not any(path.parent.iterdir()):
                    path.parent.rmdir()
            if cameras > 1:
                reader.relist(folder, gone)

        return edit

    return of


def of_pictures(change: Callable[[Path], None], why: str = "a video has one size") -> Callable[[Reader], Edit | str]:
    """Picture 5 of one camera becomes another."""
    return lambda reader: why if reader.films else lambda folder: change(reader.path(folder, reader.cameras[1], 5))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def halve(path: Path) -> None:
    image = np.asarray(Image.open(path).convert("RGB"))
    write_png(path, image[::2, ::2])


def of_videos(change: Callable[[Path], None]) -> Callable[[Reader], Edit | str]:
    """The video of one camera becomes another."""
    return lambda reader: (
        (lambda folder: change(reader.path(folder, reader.cameras[1]))) if reader.films else "pictures have no rate"
    )


def pictures_of(path: Path) -> np.ndarray:
    import av

    with av.open(str(path)) as file:
        return np.stack([frame.to_ndarray(format="rgb24", threads=1) for frame in file.decode(video=0)])


def quicker(path: Path) -> None:
    write_video(path, pictures_of(path), rate=2 * RATE)


def damaged(reader: Reader) -> Edit | str:
    if not reader.films:
        return of_pictures(cut)(reader)

    def edit(folder: Path) -> None:
        import av

        path = reader.path(folder, reader.cameras[1])
        with av.open(str(path)) as file:
            whole = [bytes(packet) for packet in file.demux(video=0) if packet.size][3]
        data = path.read_bytes().replace(whole, whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2))
        path.write_bytes(data)

    return edit


def smaller(cameras: int) -> Callable[[Reader], Edit | str]:
    """All pictures of one camera, or of all, have half the size."""

    def of(reader: Reader) -> Edit | str:
        if reader.scheme == "raw":
            return "nothing says which size pictures have"

        def edit(folder: Path) -> None:
            for camera in reader.cameras[1 : cameras + 1] if cameras == 1 else reader.cameras:
                if reader.films:
                    path = reader.path(folder, camera)
                    write_video(path, np.ascontiguousarray(pictures_of(path)[:, ::2, ::2]), rate=RATE)
                else:
                    for t in range(FRAMES):
                        halve(reader.path(folder, camera, t))

        return edit

    return of


def twins(reader: Reader) -> Edit | str:
    """What a Mac and Windows leave on the way, beside every file."""

    def edit(folder: Path) -> None:
        for path in [path for path in folder.rglob("*") if path.is_file()]:
            (path.parent / f"._{path.name}").write_bytes(bytes.fromhex("0005160700020000") + b"Mac OS X" + bytes(100))
            (path.parent / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")

    return edit


def capitals(reader: Reader) -> Edit | str:
    """.PNG and .MP4, as cameras and Windows write them; the calibration is as it was."""

    def edit(folder: Path) -> None:
        times = range(1 if reader.films else FRAMES)
        for path in [reader.path(folder, camera, t) for camera in reader.cameras for t in times]:
            path.rename(path.with_suffix(path.suffix.upper()))

    return edit


NAME = "Kamera é 1"


def odd_name(reader: Reader) -> Edit | str:
    if reader.rename is None or reader.file in ("poses_bounds.npy", "train_meta.json"):
        return "cameras have numbers"

    def edit(folder: Path) -> None:
        old = reader.cameras[1]
        assert reader.rename is not None
        reader.rename(folder, NAME)
        place = reader.path(folder, old) if reader.films else reader.path(folder, old).parent
        place.rename(place.with_name(place.name.replace(old, NAME)))

    return edit


def absent(reader: Reader) -> Edit | str:
    """The last camera has no pictures."""
    if reader.scheme == "raw":
        return "nothing says which cameras there are"

    def edit(folder: Path) -> None:
        for t in range(1 if reader.films else FRAMES):
            path = reader.path(folder, reader.cameras[-1], t)
            path.unlink()
            if not any(path.parent.iterdir()):
                path.parent.rmdir()

    return edit


def edited(name: str) -> Callable[[Reader], Edit | str]:
    return lambda reader: reader.edits[name]


def is_fisheye(found: Recording, reader: Reader) -> bool:
    """Whether a camera has the lens that the file states."""
    return Lens("fisheye", FISHEYE) in found.lenses.values()


def is_half(found: Recording, reader: Reader) -> bool:
    """Whether intrinsics are brought to pictures of half the size."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "scene"
        folder.mkdir()
        reader.write(folder)
        whole = layout(reader, folder)
    return np.allclose(found.rig.Ks[:, :2], whole.rig.Ks[:, :2] / 2, rtol=1e-9)


def layout(reader: Reader, folder: Path) -> Recording:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_layout(reader.scheme or detect(folder), folder)


@dataclass(frozen=True)
class Fault:
    """``of``: what is done to a reader's recording, or why it cannot be.

    ``right``: how the recording is known to be right where its pictures or lenses differ from those of the sound one.
    ``takes``: ``scene prepare`` may take what a run refuses, since bringing pictures to one size is its work.
    """

    of: Callable[[Reader], Edit | str]
    right: Callable[[Recording, Reader], bool] | None = None
    takes: bool = False


FAULTS: dict[str, Fault] = {
    "order: numbers without zeros, from 1": Fault(renamed(lambda t: f"frame_{t + 1}")),
    "order: every second number": Fault(renamed(lambda t: f"{2 * t + 1:04d}")),
    "gap: a picture of one camera": Fault(lost(1)),
    "gap: the same picture of all cameras": Fault(lost(4)),
    "rate: a camera twice as fast": Fault(of_videos(quicker)),
    "damage: one picture": Fault(damaged),
    "damage: a video that ends early": Fault(of_videos(cut)),
    "keys: an unknown one": Fault(edited("unknown")),
    "keys: one that says how to read numbers": Fault(edited("refused")),
    "half a camera: no pictures": Fault(absent),
    "half a camera: no pose": Fault(edited("pose")),
    "number: NaN in a pose": Fault(edited("nan")),
    "number: a matrix that does not turn": Fault(edited("turn")),
    "size: all pictures half as large": Fault(smaller(4), is_half),
    "size: those of one camera": Fault(smaller(1), takes=True),
    "size: one picture": Fault(of_pictures(halve)),
    "name: twins of a Mac, Thumbs.db": Fault(twins),
    "name: suffixes in capitals": Fault(capitals),
    "name: blanks and accents": Fault(odd_name),
    "lens: a fisheye": Fault(edited("fisheye"), is_fisheye),
    "lens: a model that is not supported": Fault(edited("lens")),
}


# verdicts ----------------------------------------------------------------------------------------------------


def instants(found: Answer, whole: Answer, names: dict[str, str]) -> list[int] | str:
    """Which instants of the sound recording are shown, or what is wrong with them."""
    shown: list[int] | None = None
    for name, pictures in found.pictures.items():
        truth = whole.pictures[names.get(name, name)]
        if pictures.shape[1:] != truth.shape[1:]:
            return f"{name} has another size"
        own = [int(np.abs(truth - picture).reshape(len(truth), -1).max(1).argmin()) for picture in pictures]
        off = max(float(np.abs(truth[t] - picture).max()) for t, picture in zip(own, pictures, strict=True))
        if off > 1e-6 or own != sorted(set(own)):
            return f"{name} shows {own}, off by {off:g}"
        if shown is not None and own != shown:
            return f"{name} shows {own}, others {shown}"
        shown = own
    return shown or []


def judged(found: Answer, whole: Answer) -> str:
    """What is lacking of the sound recording, nothing where all is there, or "wrong: ..."."""
    names = {name: name for name in found.pictures}
    if NAME in names:
        names[NAME] = next(iter(set(whole.pictures) - set(names)))
    if not set(names.values()) <= set(whole.pictures):
        return f"wrong: cameras {sorted(found.pictures)}"
    if any(not np.allclose(pose, whole.poses[names[n]], atol=1e-9) for n, pose in found.poses.items()):
        return "wrong: poses"
    if found.fps != whole.fps:
        return f"wrong: {found.fps} frames per second"
    shown = instants(found, whole, names)
    if isinstance(shown, str):
        return f"wrong: {shown}"
    lacking = [n for n in whole.pictures if n not in names.values()]
    return ", ".join(lacking + ([f"{len(shown)} of {FRAMES} instants"] if len(shown) < FRAMES else []))


def cell(fault: str, name: str) -> tuple[str, str]:
    """The verdict on a cell, and the words that go with it."""
    reader, kind = READERS[name], FAULTS[fault]
    edit = kind.of(reader)
    if isinstance(edit, str):
        return "does not apply", edit
    with tempfile.TemporaryDirectory() as place:
        folder = shutil.copytree(written(name), Path(place) / "scene")
        edit(folder)
        given = answers(reader, folder)
        first = given.get("run", given["prepare"])
        if first.refused:
            return refusal(given, kind.takes)
        fine = kind.right is None or reader.scheme == "raw" or kind.right(layout(reader, folder), reader)
    if not fine:
        return "wrong", "the calibration is not what the file says"
    told = {door: judged(one, sound(name)[door]) for door, one in given.items() if one.pictures}
    if kind.right is None and (bad := next((words for words in told.values() if words.startswith("wrong")), "")):
        return "wrong", f"{told}: {bad}"
    if "growing recording needs" in given.get("watch", first).refused:
        del given["watch"]  # which says that it takes pinhole pictures alone
    if any(one.refused or (one.pictures and set(one.pictures) != set(first.pictures)) for one in given.values()):
        return "wrong", f"doors differ: {[(door, one.refused) for door, one in given.items()]}"
    if len({one.told for door, one in given.items() if door != "watch"}) > 1:
        return "wrong", f"doors warn differently: {[(door, sorted(one.told)) for door, one in given.items()]}"
    if more := first.told - sound(name)[next(iter(given))].told:
        return "warned", " | ".join(sorted(more))
    if kind.right is None and any(told.values()):
        return "wrong", f"in silence: {told}"
    return "right", ""


def refusal(given: dict[str, Answer], takes: bool) -> tuple[str, str]:
    first = given.get("run", given["prepare"])
    for door, one in given.items():
        # Whoever watches waits for what is missing, and for a picture to be whole: the recording ends before it.
        if not one.refused and door != "watch" and not (takes and door == "prepare"):
            return "wrong", f"{door} takes what run refuses: {first.refused}"
        if "\n" in one.refused:
            return "wrong", f"{door}: more than one line"
    return "refused", first.refused


def rows() -> dict[str, dict[str, tuple[str, str]]]:
    return {fault: {name: cell(fault, name) for name in READERS} for fault in FAULTS}


def main() -> None:
    """Write every cell; with names of faults or readers, print those cells alone."""
    chosen = sys.argv[1:]
    if not chosen:
        made = {fault: {name: list(one) for name, one in row.items()} for fault, row in rows().items()}
        CELLS.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return
    for fault in FAULTS:
        for name in READERS:
            if any(word in (fault, name) or fault.startswith(word) for word in chosen):
                print(f"{fault} | {name} | {' | '.join(cell(fault, name))}")


if __name__ == "__main__":
    main()
