"""What a run starts from: a recording by its URI, those of plugins included, and frame 0 of another stream."""

from __future__ import annotations

from pathlib import Path

from gsstream.core.errors import GsstreamError, PacketError, PluginUnavailable
from gsstream.packet import PlayerState, StreamReader, decode_packet
from gsstream.plugins.catalog import Catalog
from gsstream.source.base import FrameSource
from gsstream.source.open import open_source


def open_recording(uri: str, scale: float, catalog: Catalog) -> FrameSource:
    """Open ``uri``: a source part of a plugin when its scheme names one, else one of the built-in sources.

    Arguments:
        uri: "demo", "synthetic:...", a folder, or "NAME:..." where NAME is a part of the kind "source".
        scale: images are shrunk by this factor in (0, 1] on reading.

    Raises:
        SourceError: the recording cannot be read.
        PluginUnavailable: the source's plugin cannot be loaded or failed to open the recording.
    """
    scheme = uri.partition(":")[0]
    entry = catalog.entries.get(("source", scheme))
    if entry is None or entry.plugin == "builtin":
        return open_source(uri, scale)
    factory = catalog.resolve("source", scheme)
    try:
        source: FrameSource = factory(uri, scale)
    except GsstreamError:
        raise
    except Exception as error:  # third-party code: reported with its owner's name
        raise PluginUnavailable(f"source {scheme!r} (from {entry.origin}) could not open {uri!r}: {error}") from error
    return source


def read_first_frame(path: Path) -> PlayerState:
    """The decoded first frame of a stream.

    Raises SourceError when there is no such file, PacketError when its first packet is missing or damaged.
    """
    with StreamReader(path) as reader:
        if not reader.frames:
            raise reader.damage or PacketError(f"{path} holds no complete packet yet", reader.end)
        entry = reader.frames[0]
        return decode_packet(None, reader.read(entry), offset=entry.offset)
