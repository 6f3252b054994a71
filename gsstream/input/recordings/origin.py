"""Where a recording lies: streams say only which one it is, the folder of a run keeps the rest."""

from __future__ import annotations

import os
from pathlib import Path

from gsstream.core.names import last_part
from gsstream.input.recordings.detect import LAYOUTS
from gsstream.store.address import is_address

#: File of a run's folder that holds what ``--source`` needs to open the recording again.
RECORDING = "recording.txt"
#: Bytes of it that are read; no path and no address is longer.
_LONGEST = 1 << 16


def public_uri(uri: str) -> str:
    """Return which recording an uri means without where it lies: this is what a stream, which is published, may say.

    The demo and synthetic scenes stay as they are. The origin of a folder, and of the address of one, is the last part
    of its path, behind the layout where one is stated. That of a plugin's source is the name of the source alone,
    because what follows may be an address with a password.
    """
    scheme, colon, rest = uri.partition(":")
    if uri == "demo" or (colon and scheme == "synthetic"):
        return uri
    if colon and scheme == "rig":
        return f"rig:{last_part(rest)}"
    if colon and scheme in LAYOUTS:
        path, mark, query = rest.partition("?")
        return f"{scheme}:{_folder(path)}{mark}{query}"
    if _names_a_plugin(scheme, colon) and not is_address(uri):
        return f"{scheme}:"
    return _folder(uri)


def whole_uri(uri: str) -> str:
    """Return an uri that means the same recording from every folder of this machine."""
    scheme, colon, rest = uri.partition(":")
    if colon and scheme in LAYOUTS and not is_address(rest):
        return f"{scheme}:{os.path.abspath(rest)}"
    if uri == "demo" or is_address(rest) or _names_a_plugin(scheme, colon):
        return uri
    return os.path.abspath(uri)


def read_recording(stream: Path) -> str | None:
    """Return what the folder of a run says of the recording of its stream; None where no run's folder is around it."""
    if stream.name != "stream.gss":
        return None
    try:
        with (stream.parent / RECORDING).open("rb") as file:
            return os.fsdecode(file.read(_LONGEST)).removesuffix("\n")
    except OSError:
        return None


def _names_a_plugin(scheme: str, colon: str) -> bool:
    """Whether a text before a colon is the name of a source; one letter is a drive, and a path has separators."""
    return bool(colon) and len(scheme) > 1 and not {"/", "\\"} & set(scheme)


def _folder(path: str) -> str:
    """The name of a folder, also of one that is given as "." or as "..", and not that of what a link leads to."""
    name = last_part(path)
    return name if name not in ("", ".", "..") else last_part(os.path.abspath(path))
