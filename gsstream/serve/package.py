"""Put a stream and the browser player into one folder that any web server or CDN serves as it is."""

from __future__ import annotations

import hashlib
import html
import io
import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from gsstream.core.errors import InputError, OutputError
from gsstream.core.shapes import IntArray
from gsstream.packet import FORMAT_VERSION, Entry, PacketKind, StreamReader, decode_key, decode_packet
from gsstream.packet.base import file_header
from gsstream.player.playback import Playback
from gsstream.player.render import render, to_bytes
from gsstream.player.rows import track_rows
from gsstream.serve.joins import encode_join

MANIFEST, POSTER = "stream.json", "poster.jpg"
SEGMENTS = "segments"
#: What no browser needs of a module: empty lines, comments that fill whole lines, indentation. A fifth of its bytes.
_SPARE = re.compile(rb"^[ \t]*(?://[^\n]*|/\*\*.*?\*/)?\n|^[ \t]+", re.MULTILINE | re.DOTALL)


class Package(NamedTuple):
    """A written package: folder, segments and joins (of all renditions), and the bytes of each and of the player."""

    folder: Path
    segments: int
    joins: int
    stream_bytes: int
    join_bytes: int
    player_bytes: int


def package(
    stream: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    renditions: Sequence[str | os.PathLike[str]] = (),
    join_every: float = 10.0,
) -> Package:
    """Write page, manifest and one file for each key segment.

    A segment is a key packet with all that follows up to the next one, behind a file header: a valid stream. Its name
    holds a digest of its bytes, so that it never changes under that name and may be cached for ever.

    Raises SourceError when there is no stream, PacketError when it is damaged, InputError when a rendition has other
    frames or ``join_every`` is negative, OutputError when the folder holds something else or cannot be written.
    """
    folder = Path(out)
    if not (math.isfinite(join_every) and join_every >= 0):
        raise InputError(f"join_every: expected seconds, 0 or more, got {join_every}")
    old = _old_files(folder)
    try:
        (folder / SEGMENTS).mkdir(parents=True, exist_ok=True)
        main, *others = [_write_stream(Path(path), folder, join_every) for path in (stream, *renditions)]
        for path, other in zip(renditions, others, strict=True):
            _check_frames(path, other, main)
        manifest = {"format": f"gsstream {FORMAT_VERSION}", "poster": POSTER, **main, "renditions": others}
        new = _files(manifest)
        size = 0
        for name, data in player_files():
            (folder / name).parent.mkdir(exist_ok=True)
            size += (folder / name).write_bytes(data)
        page = folder / "index.html"
        _replace(page, _titled(page.read_text(encoding="utf-8"), main["name"]).encode())
        _replace(folder / POSTER, _poster(Path(stream)))
        # The manifest last, so that a concurrent reader finds every file that it names.
        _replace(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
        for name in old - new:
            (folder / name).unlink(missing_ok=True)
    except BaseException as error:
        _remove_partial(folder, old)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write the package {folder}: {error.strerror or error}") from error
        raise
    segments = {s["file"]: s["bytes"] for entry in (main, *others) for s in entry["segments"]}
    joins = {j["file"]: j["bytes"] for entry in (main, *others) for s in entry["segments"] for j in s["joins"]}
    return Package(
        folder=folder,
        segments=len(segments),
        joins=len(joins),
        stream_bytes=sum(segments.values()),
        join_bytes=sum(joins.values()),
        player_bytes=size,
    )


def _files(manifest: dict[str, Any]) -> set[str]:
    """Return the names of all segments and joins of a manifest."""
    segments = [segment for entry in (manifest, *manifest["renditions"]) for segment in entry["segments"]]
    return {str(part["file"]) for segment in segments for part in (segment, *segment.get("joins", ()))}


def _old_files(folder: Path) -> set[str]:
    """Files of the package that is there. Raises OutputError when something else is."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return set()
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        files = _files(manifest)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise OutputError(
            f"{folder} holds something that is no package: expected an empty folder, a new one, or one with {MANIFEST}"
        ) from error
    # Only names that packages give to segments are removed: a manifest that somebody else wrote removes no other file.
    return {name for name in files if Path(name).parent == Path(SEGMENTS) and Path(name).suffix in (".gss", ".gsj")}


def _remove_partial(folder: Path, old: set[str]) -> None:
    """Remove the files of a package that failed from the folder of the package before it."""
    for path in (folder / SEGMENTS).glob("*"):
        if f"{SEGMENTS}/{path.name}" not in old:
            path.unlink(missing_ok=True)
    for place in (folder / SEGMENTS, folder):
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()


def _write_stream(path: Path, folder: Path, join_every: float) -> dict[str, Any]:
    """Write the segments of a stream; returns its entry in the manifest."""
    with StreamReader(path) as reader:
        reader.check()
        starts = [i for i, entry in enumerate(reader.frames) if entry.kind == PacketKind.KEY]
        if not starts:
            raise InputError(f"{path}: expected at least one complete frame, got none")
        first = decode_key(reader.read(reader.frames[0]), offset=reader.frames[0].offset)
        every = max(1, round(join_every * first.meta.fps)) if join_every else len(reader.frames)
        segments = [
            _write_segment(reader, reader.frames[start:stop], folder, every)
            for start, stop in zip(starts, [*starts[1:], len(reader.frames)], strict=True)
        ]
        frames = reader.frames
    return {
        "name": path.parent.name if path.name == "stream.gss" else path.stem,
        "fps": first.meta.fps,
        "frames": len(frames),
        "first_frame": frames[0].frame,
        "gaussians": len(first.gaussians),
        "segments": segments,
    }


def _write_segment(reader: StreamReader, entries: Sequence[Entry], folder: Path, every: int) -> dict[str, Any]:
    """Write a key packet with the packets after it, and a join after every so many frames; return its entry."""
    with reader.path.open("rb") as file:  # its own header: a stream may be of an older minor version
        header = file.read(len(file_header()))
    data = header + b"".join(reader.read(entry) for entry in entries)
    shift = len(header) - entries[0].offset
    segment: dict[str, Any] = {
        "frames": [entries[0].frame, entries[-1].frame],
        "file": _write(folder, entries[0].frame, ".gss", data),
        "bytes": len(data),
        "key_bytes": shift + entries[0].offset + entries[0].size,
        "joins": [],
    }
    if len(entries) <= every:
        return segment
    state = key = decode_packet(None, reader.read(entries[0]), offset=entries[0].offset)
    source: IntArray = np.arange(len(key.gaussians), dtype=np.int64)
    # A join holds the state that the packet at its offset continues from.
    for number, entry in enumerate(entries[1:], 1):
        if number % every == 0:
            data = encode_join(key, state, source)
            name = _write(folder, entry.frame, ".gsj", data)
            join = {"frame": entry.frame, "offset": shift + entry.offset, "file": name, "bytes": len(data)}
            segment["joins"].append(join)
        state = decode_packet(state, reader.read(entry), offset=entry.offset)
        source = track_rows(source, state)
    return segment


def _write(folder: Path, frame: int, suffix: str, data: bytes) -> str:
    """Write a file that is named by its frame and a digest of its bytes; returns its name in the package."""
    name = f"{SEGMENTS}/{frame:06d}-{hashlib.sha256(data).hexdigest()[:12]}{suffix}"
    _replace(folder / name, data)
    return name


def _check_frames(path: str | os.PathLike[str], entry: dict[str, Any], main: dict[str, Any]) -> None:
    for name in ("first_frame", "frames", "fps"):
        if entry[name] != main[name]:
            what = name.replace("_", " ")
            raise InputError(f"rendition {path}: expected {what} {main[name]} as in the stream, got {entry[name]}")


def _replace(path: Path, data: bytes) -> None:
    """Write a file atomically: no reader sees half of it."""
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(data)
    partial.replace(path)


def _poster(stream: Path) -> bytes:
    """The first frame as the page shows it at first, as JPEG."""
    with Playback(stream) as playback:
        meta = playback.meta
        cameras = meta.camera((*meta.test.ids, *meta.train.ids)[0])
        scene = playback.state_at(playback.frames[0])
        picture = to_bytes(render(scene, cameras, 0, meta.background))
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "JPEG", quality=85, progressive=True)
    return data.getvalue()


def _titled(page: str, name: str) -> str:
    """Return the page with a title, and the preview that other pages show of a link to it."""
    title = html.escape(name)
    tags = f"""<link rel="preload" as="image" href="{POSTER}">
<meta property="og:title" content="{title}">\n<meta property="og:image" content="{POSTER}">"""
    return page.replace("<title>gsstream</title>", f"<title>{title}</title>\n{tags}").replace(
        "<h1>gsstream</h1>", f"<h1>{title}</h1>"
    )


def player_files(folder: Traversable | None = None, above: str = "") -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of the player's files, what is its own without comments and indentation.

    ``folder`` and ``above``: where to begin, and its name; by default all files.
    """
    folder = resources.files("gsstream") / "web" if folder is None else folder
    for item in sorted(folder.iterdir(), key=lambda item: item.name):
        if item.is_dir():
            yield from player_files(item, f"{above}{item.name}/")
        elif not item.name.startswith((".", "__")):
            data = item.read_bytes()
            is_own = item.name.endswith((".js", ".html")) and folder.name != "vendor"
            yield f"{above}{item.name}", _SPARE.sub(b"", data) if is_own else data
