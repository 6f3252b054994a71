"""Opening a recording by its URI, those of plugins included."""

from __future__ import annotations

from gsstream.core.errors import GsstreamError, PluginUnavailable
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
