"""Turn what the user typed into a frame source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsstream.core.errors import SourceError
from gsstream.core.install_hints import install_part
from gsstream.input.recordings.base import Source, Wrapped
from gsstream.input.recordings.detect import LAYOUTS, detect, reader
from gsstream.input.recordings.recorded import RecordedSource, Recording
from gsstream.store.address import is_address

if TYPE_CHECKING:
    from gsstream.store.fetch import Fetched

DEMO_FOLDER = Path(__file__).parent / "demo" / "pickblocks_tiny_160"
_KNOWN = (
    "'demo' (a small recording inside the package), "
    "'synthetic:' with options such as 'synthetic:frames=40&views=8' (an analytic scene of any length), "
    "'watch:DIR' (a folder that is still being written), "
    f"or the path of a folder, read by its layout or as you say: {':DIR, '.join(LAYOUTS)}:DIR; in place of DIR, "
    "s3://BUCKET/DIR, gs://BUCKET/DIR or https://SERVER/DIR"
)


def open_source(uri: str, scale: float = 1.0) -> Source:
    """Open a recording. Raises SourceError for an unknown uri, naming what exists, and for a faulty recording."""
    if uri == "demo":
        return RecordedSource(read_layout("folder", DEMO_FOLDER), scale=scale, uri=uri)
    scheme, separator, rest = uri.partition(":")
    if separator and scheme == "synthetic":
        from gsstream.input.recordings.synthetic import SyntheticSource

        return SyntheticSource.from_query(rest, scale=scale, uri=uri)
    if separator and scheme == "watch":
        from gsstream.input.recordings.watch import WatchSource

        return WatchSource.from_query(rest, scale=scale)
    named, place = _named(uri)
    if is_address(place):
        return _fetched(place, named, scale, uri)
    return RecordedSource(read_recording(uri), scale=scale, uri=uri)


def read_recording(uri: str) -> Recording:
    """Read a folder that is there: a path, or ``LAYOUT:DIR``; ``nerfstudio:DIR`` takes ``?missing=refuse``.

    Raises SourceError for another option, for a folder of no layout or of several, and for a faulty recording.
    """
    named, place = _named(uri)
    folder = Path(place)
    # Path takes an empty text for the current folder, which is never what was meant.
    if not (uri and _exists(folder)) and not named:
        scheme, separator, _ = uri.partition(":")
        if separator and (command := install_part("source", scheme)):
            raise SourceError(f"source {uri[:200]!r}: the source {scheme!r} comes with another distribution: {command}")
        raise SourceError(f"source {uri[:200]!r}: no such folder and no known scheme; expected {_KNOWN}")
    options: dict[str, str] = {}
    if named == "nerfstudio" and not _exists(folder):
        text, _, query = place.partition("?")
        if query not in ("", "missing=refuse", "missing=skip"):
            raise SourceError(f"source {uri[:200]!r}: expected ?missing=skip or ?missing=refuse, got ?{query[:100]}")
        folder, options = Path(text), {"missing": query.partition("=")[2] or "skip"}
    return read_layout(named or detect(folder), folder, **options)


def _named(uri: str) -> tuple[str | None, str]:
    """The layout that an address names, if it does, and the rest of it."""
    layout, separator, place = uri.partition(":")
    return (layout, place) if separator and layout in LAYOUTS else (None, uri)


def _fetched(address: str, named: str | None, scale: float, uri: str) -> Source:
    """A recording of a store, from the copy in the cache."""
    from gsstream.store.fetch import fetched

    copy = fetched(address)
    try:
        recording = read_layout(named or detect(copy.folder), copy.folder)
        return _FetchedSource(RecordedSource(recording, scale=scale, uri=uri), copy)
    except BaseException:
        copy.close()
        raise


class _FetchedSource(Wrapped):
    """A recording whose files stay in the cache for as long as it is open."""

    def __init__(self, source: Source, copy: Fetched) -> None:
        super().__init__(source)
        self._copy = copy

    def close(self) -> None:
        """Close the recording, and let go of its files."""
        super().close()
        self._copy.close()


def _exists(folder: Path) -> bool:
    """Whether there is such a folder or file. Raises SourceError for a text that cannot be a path at all."""
    try:
        return folder.exists()
    except (OSError, ValueError) as error:
        raise SourceError(f"source {str(folder)[:200]!r} cannot be a path: {error}") from error


def read_layout(name: str, folder: Path, **options: str) -> Recording:
    """Read a folder as the layout ``name``, with its options. Raises SourceError when it is none, or a faulty one."""
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected {LAYOUTS[name][1]}")
    recording: Recording = reader(name).read(folder, **options)
    return replace(recording, folder=folder)
