"""Turn what the user typed into a frame source."""

from __future__ import annotations

from pathlib import Path

from gsstream.core.errors import SourceError
from gsstream.source.base import FrameSource
from gsstream.source.multiview import MultiviewSource

DEMO_FOLDER = Path(__file__).parent / "demo" / "pickblocks_tiny_160"
_KNOWN = (
    "'demo' (a small recording inside the package), "
    "'synthetic:' with options such as 'synthetic:frames=40&views=8' (an analytic scene of any length), "
    "'watch:DIR' (a folder that is still being written), "
    "or the path of a folder with cameras.json"
)


def open_source(uri: str, scale: float = 1.0) -> FrameSource:
    """Open a recording.

    Arguments:
        uri: ``demo``, ``synthetic:key=value&...``, ``watch:DIR?key=value&...`` or the path of a folder
            that holds cameras.json.
        scale: images are shrunk by this factor in (0, 1] on reading.

    Raises SourceError for an unknown uri, naming what exists, and for a faulty recording.
    """
    if uri == "demo":
        return MultiviewSource(DEMO_FOLDER, scale=scale, uri=uri)
    scheme, separator, rest = uri.partition(":")
    if separator and scheme == "synthetic":
        from gsstream.source.synthetic import SyntheticSource

        return SyntheticSource.from_query(rest, scale=scale, uri=uri)
    if separator and scheme == "watch":
        from gsstream.source.watch import WatchSource

        return WatchSource.from_query(rest, scale=scale)
    folder = Path(uri)
    # An empty text is the current folder to Path, and never what was meant.
    if uri and folder.exists():
        return MultiviewSource(folder, scale=scale, uri=uri)
    raise SourceError(f"source {uri!r}: no such folder and no known scheme; expected {_KNOWN}")
