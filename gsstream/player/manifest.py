"""A stream's table of contents as JSON: with it a client of any static web server fetches packets by byte range."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from gsstream.packet import FORMAT_VERSION, PacketKind, StreamReader
from gsstream.packet.base import FILE_HEADER, PACKET_HEADER
from gsstream.player.playback import Playback


def manifest(stream: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the byte ranges of a stream's packets; ``range`` is [first, last], inclusive as in HTTP.

    The file header (``header``) followed by any of the ``segments`` (a key packet with what follows up to the next) is
    a stream of its own. Raises PacketError for a damaged stream, SourceError when there is none.
    """
    with StreamReader(stream) as reader:
        reader.check()
        packets = [
            {"frame": e.frame, "kind": e.kind.name.lower(), "range": [e.offset, e.offset + e.size - 1]}
            for e in reader.frames
        ]
        end = reader.frames[-1].offset + reader.frames[-1].size if reader.frames else FILE_HEADER.size
        keys = [e for e in reader.frames if e.kind == PacketKind.KEY]
    with Playback(stream) as playback:
        fps, frames = playback.meta.fps, playback.frames
    ends = [key.offset for key in keys[1:]] + [end]
    last = [key.frame - 1 for key in keys[1:]] + [frames[-1]]
    return {
        "format": f"gsstream {FORMAT_VERSION}",
        "file": Path(stream).name,
        "fps": fps,
        "frames": len(packets),
        "first_frame": frames[0],
        "header": [0, FILE_HEADER.size - 1],
        "packet_header_bytes": PACKET_HEADER.size,
        "segments": [
            {"frames": [key.frame, final], "range": [key.offset, stop - 1]}
            for key, final, stop in zip(keys, last, ends, strict=True)
        ],
        "packets": packets,
    }


def manifest_json(stream: str | os.PathLike[str]) -> str:
    """Return the :func:`manifest` as text."""
    return json.dumps(manifest(stream), indent=1) + "\n"
