"""Names and places: which ids may be file names, how a name is joined to a folder, and what of a path is a name."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsstream.core.errors import OutputError, ShapeError

#: File systems take 255 bytes in a name; a suffix, a prefix and a frame number must fit besides.
MAX_NAME_BYTES = 120
#: Names that Windows gives to devices, with any suffix and in any case.
_DEVICES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))})


def check_camera_ids(ids: Iterable[str]) -> None:
    """Refuse camera ids that could not be the name of one folder: pictures of a camera lie in a folder of its name.

    Raises ShapeError naming the first id that is empty, longer than 120 bytes, "." or "..", reserved by an operating
    system, or that has a separator, a control character or half of a surrogate pair in it.
    """
    for name in ids:
        if (fault := name_fault(name)) is not None:
            raise ShapeError(
                f"camera id {name[:60]!r}: {fault}. Pictures of a camera are written to a folder of its name: rename "
                "the camera, with letters, digits, '-' and '_', e.g. 'cam01'"
            )


def name_fault(name: str) -> str | None:
    """Return, as a clause, why a text cannot be the name of one file or folder; None: it can."""
    if not name:
        return "it is empty"
    if name in (".", ".."):
        return "it names a folder that exists everywhere"
    for sign in name:
        if sign in "/\\:":
            return f"it holds {sign!r}, which separates the parts of a path"
        if unicodedata.category(sign) in ("Cc", "Cs", "Zl", "Zp"):
            return f"it holds the control character {sign!r}"
    if len(name.encode()) > MAX_NAME_BYTES:
        return f"it is {len(name.encode())} bytes long; expected at most {MAX_NAME_BYTES}"
    if name != name.rstrip(". "):
        return "it ends with a dot or a space, which some file systems drop"
    if name.partition(".")[0].lower() in _DEVICES:
        return "it is the name of a device on some systems"
    return None


def child(folder: Path, name: str) -> Path:
    """Return ``folder / name``, which lies directly in the folder whatever the name is.

    Raises OutputError when the name could lead elsewhere. This is the last check before a file is written; ids are
    already checked where they are read.
    """
    if (fault := name_fault(name)) is not None:
        raise OutputError(f"cannot write {name[:60]!r} into {folder}: {fault}")
    return folder / name


def last_part(text: str) -> str:
    """Return the name in a path or an address: no folder, no machine, no user, no password, no query is left of it."""
    _, is_address, rest = text.partition("://")
    if is_address:
        text = re.split(r"[?#]", rest)[0].rpartition("@")[2]
    return re.split(r"[/\\]", text.rstrip("/\\"))[-1]


def without_places(value: Any) -> Any:
    """Return plain JSON values in which every text that is a path or an address is only its last part."""
    if isinstance(value, Mapping):
        return {key: without_places(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_places(inner) for inner in value]
    return last_part(value) if isinstance(value, str) and re.search(r"[/\\]", value) else value
