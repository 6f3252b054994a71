"""Put a stream and the browser player into one folder that any web server or CDN serves as it is."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

from gsstream.core.errors import InputError, OutputError
from gsstream.packet import FORMAT_VERSION, PacketKind, StreamReader, decode_key
from gsstream.packet.base import file_header

MANIFEST = "stream.json"
SEGMENTS = "segments"


class Package(NamedTuple):
    """What was written: the folder, the number of segments (of all renditions) and the bytes of streams and player."""

    folder: Path
    segments: int
    stream_bytes: int
    player_bytes: int


def package(
    stream: str | os.PathLike[str], out: str | os.PathLike[str], *, renditions: Sequence[str | os.PathLike[str]] = ()
) -> Package:
    """Write page, manifest and one file for each key segment.

    A segment is a key packet with all that follows up to the next one, behind a file header: a valid stream. Its name
    holds a digest of its bytes, so that it never changes under that name and may be cached for ever.

    Arguments:
        stream: the stream to be packaged; nothing of it is coded anew.
        out: a folder that is empty, does not exist, or holds a package, which is replaced.
        renditions: other streams of the same recording; a viewer may change to them at key packets.

    Raises SourceError when there is no stream, PacketError when it is damaged, InputError when a rendition has other
    frames, OutputError when the folder holds something else or cannot be written.
    """
    folder = Path(out)
    old = _old_segments(folder)
    try:
        (folder / SEGMENTS).mkdir(parents=True, exist_ok=True)
        main, *others = [_write_stream(Path(path), folder) for path in (stream, *renditions)]
        for path, other in zip(renditions, others, strict=True):
            _check_frames(path, other, main)
        manifest = {"format": f"gsstream {FORMAT_VERSION}", **main, "renditions": others}
        new = {segment["file"] for entry in (main, *others) for segment in entry["segments"]}
        size = _copy(resources.files("gsstream") / "web", folder)
        # The manifest last: whoever reads the folder meanwhile finds every file that it names.
        _replace(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
        for name in old - new:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write the package {folder}: {error.strerror or error}") from error
    total = sum(segment["bytes"] for entry in (main, *others) for segment in entry["segments"])
    return Package(folder, len(new), total, size)


def _old_segments(folder: Path) -> set[str]:
    """Files of the package that is there. Raises OutputError when something else is."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return set()
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        entries = [manifest, *manifest["renditions"]]
        files = {str(segment["file"]) for entry in entries for segment in entry["segments"]}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise OutputError(
            f"{folder} holds something that is no package: expected an empty folder, a new one, or one with {MANIFEST}"
        ) from error
    # Only what a package names there: a manifest that somebody else wrote removes nothing beyond its own segments.
    return {name for name in files if Path(name).parent == Path(SEGMENTS) and Path(name).suffix == ".gss"}


def _write_stream(path: Path, folder: Path) -> dict[str, Any]:
    """Write the segments of a stream; returns its entry in the manifest."""
    with StreamReader(path) as reader:
        reader.check()
        if reader.version != FORMAT_VERSION:
            raise InputError(f"{path}: expected packet format {FORMAT_VERSION}, got {reader.version}; encode it again")
        starts = [i for i, entry in enumerate(reader.frames) if entry.kind == PacketKind.KEY]
        if not starts:
            raise InputError(f"{path}: expected at least one complete frame, got none")
        first = decode_key(reader.read(reader.frames[0]), offset=reader.frames[0].offset)
        segments = []
        for start, stop in zip(starts, [*starts[1:], len(reader.frames)], strict=True):
            entries = reader.frames[start:stop]
            data = file_header() + b"".join(reader.read(entry) for entry in entries)
            name = f"{SEGMENTS}/{entries[0].frame:06d}-{hashlib.sha256(data).hexdigest()[:12]}.gss"
            _replace(folder / name, data)
            segments.append({"frames": [entries[0].frame, entries[-1].frame], "file": name, "bytes": len(data)})
        frames = reader.frames
    return {
        "name": path.parent.name if path.name == "stream.gss" else path.stem, "fps": first.meta.fps,
        "frames": len(frames), "first_frame": frames[0].frame, "gaussians": len(first.gaussians), "segments": segments,
    }  # fmt: skip


def _check_frames(path: str | os.PathLike[str], entry: dict[str, Any], main: dict[str, Any]) -> None:
    for name in ("first_frame", "frames", "fps"):
        if entry[name] != main[name]:
            what = name.replace("_", " ")
            raise InputError(f"rendition {path}: expected {what} {main[name]} as in the stream, got {entry[name]}")


def _replace(path: Path, data: bytes) -> None:
    """Write a file in one step: nobody sees half of it."""
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(data)
    partial.replace(path)


def _copy(source: Traversable, target: Path) -> int:
    """Copy the player's files; returns their bytes."""
    size = 0
    for item in source.iterdir():
        if item.is_dir():
            (target / item.name).mkdir(exist_ok=True)
            size += _copy(item, target / item.name)
        elif not item.name.startswith((".", "__")):
            with item.open("rb") as data, (target / item.name).open("wb") as out:
                shutil.copyfileobj(data, out)
            size += (target / item.name).stat().st_size
    return size
