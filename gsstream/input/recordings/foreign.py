"""Files of other programs: no key is passed over in silence, and no number is used before it is checked.

Every message names file and key, and is one sentence.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np

from gsstream.core.errors import SourceError, suggest
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.sync import RecordingWarning

#: Pictures with a longer side do not exist.
MAX_SIDE = 1 << 16
#: Larger numbers overflow as soon as they are used.
MAX_NUMBER = 1e300


@dataclass(frozen=True, slots=True)
class Keys:
    """What a format may hold: names with blanks between them. ``*`` at the end stands for any ending."""

    read: str
    #: Known, and without effect on poses, lenses, times and points.
    idle: str = ""
    #: These keys change how numbers are to be read, which gsstream does not support: they are refused unless their
    #: value has no effect (zero, false, null, empty).
    refused: str = ""


def check_keys(where: str, found: Iterable[Mapping[str, Any]], known: Keys) -> None:
    """Warn of keys that no list holds, with the nearest known name; these objects are of one kind.

    Raises SourceError for a refused key that says something, and for another spelling of a key that is read.
    """
    unknown: dict[str, None] = {}
    read, idle, refused = known.read.split(), known.idle.split(), known.refused.split()
    spelled = {_bare(key): key for key in read if not key.endswith("*")}
    fine, bad = _test(read + idle), _test(refused)
    for entry in found:
        for key, value in entry.items():
            if bad(key):
                if _says(value):
                    text = f"{where}: {key!r} is not supported, and says how to read the file, got {brief(value)}"
                    raise SourceError(f"{text}: export without this key, or undistort the pictures")
            elif not fine(key):
                if near := spelled.get(_bare(key)):
                    raise SourceError(f"{where}: the key {key!r} is not known; did you mean {near!r}?")
                unknown[key] = None
    if unknown:
        names = [key.rstrip("*") for key in (*read, *idle)]
        near = suggest(next(iter(unknown)), names) if len(unknown) == 1 else ""
        listed = ", ".join(f"{key!r}" for key in list(unknown)[:8]) + (", ..." if len(unknown) > 8 else "")
        near = near if "did you mean" in near else ""
        warn(f"{where}: keys that are not known have no effect: {listed}{near}")


def _test(names: Sequence[str]) -> Callable[[str], bool]:
    """Whether a key is one of these names."""
    whole = frozenset(names)
    beginnings = tuple(name[:-1] for name in names if name.endswith("*"))
    return lambda key: key in whole or key.startswith(beginnings)


def _bare(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _says(value: Any) -> bool:
    """Whether a value says more than that there is nothing to say."""
    if isinstance(value, Mapping | list | tuple):
        return any(_says(item) for item in (value.values() if isinstance(value, Mapping) else value))
    try:
        return float(value) != 0
    except (TypeError, ValueError, OverflowError):
        return str(value).lower() not in ("", "none", "null", "false")


def warn(text: str) -> None:
    """Warn of something in a recording that deserves a look."""
    warnings.warn(text, RecordingWarning, stacklevel=3)


@contextmanager
def reading(where: Any, what: str) -> Iterator[None]:
    """What does not parse in here is a SourceError that says where, and what was expected."""
    try:
        yield
    except SourceError:  # is a ValueError, too
        raise
    except KeyError as error:
        raise SourceError(f"{where}: not {what}: there is no {error}") from error
    except (ValueError, TypeError, IndexError, OverflowError, ParseError) as error:
        raise SourceError(f"{where}: not {what}: {error}") from error


def left_out(where: str, why: str, names: Sequence[str], stay: int, *, what: str = "cameras") -> None:
    """Warn of cameras that are only half there, with those that stay. Raises SourceError where none stay."""
    if not names:
        return
    text = f"{where}: {what} {why} are left out: {', '.join(names)}; {stay} of {stay + len(names)} stay"
    if not stay:
        raise SourceError(f"{text}: restore what is missing")
    warn(text)


def number(
    where: str, key: str, value: Any, *, above: float = -math.inf, below: float = math.inf, expected: str = ""
) -> float:
    """Return a finite number between bounds that are left out. Raises SourceError for anything else, texts included."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < MAX_NUMBER
    if not good or not above < value < below:
        expected = expected or ("a positive number" if above == 0 else "a finite number")
        raise SourceError(f"{where}: {key} must be {expected}, got {brief(value)}")
    return float(value)


def pixels(where: str, key: str, value: Any) -> int:
    """Return a whole number of pixels, at least 1. Raises SourceError for anything else."""
    side = number(where, key, value, above=0, below=MAX_SIDE + 1, expected=f"whole pixels from 1 to {MAX_SIDE}")
    if side != int(side):
        raise SourceError(f"{where}: {key} must be whole pixels from 1 to {MAX_SIDE}, got {brief(value)}")
    return int(side)


def matrix(where: str, key: str, value: Any, *shapes: tuple[int, ...]) -> FloatArray:
    """Return finite numbers of one of these shapes, float64. Raises SourceError for anything else, texts included."""
    text = f"{where}: {key} must be {' or '.join(' x '.join(map(str, shape)) for shape in shapes)} finite numbers"
    try:
        cells = np.array(value, dtype=object)
    except ValueError as error:
        raise SourceError(f"{text}, got lists of different lengths") from error
    if cells.shape not in shapes:
        raise SourceError(f"{text}, got {list(cells.shape) if cells.shape else brief(value)}")
    for cell in cells.flat:
        number(where, f"{key}: every element", cell)
    return cells.astype(np.float64)


def parsed(where: str, key: str, words: Sequence[Any], *counts: int) -> FloatArray:
    """Return the finite numbers that texts stand for, as many as one of ``counts`` (any number where there is none).

    Raises SourceError for anything else.
    """
    try:
        values = np.array([float(word) for word in words], np.float64)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{where}: {key} holds something that is not a number ({error})") from error
    if (counts and len(values) not in counts) or not np.isfinite(values).all():
        expected = f"{' or '.join(map(str, counts))} finite numbers" if counts else "finite numbers"
        raise SourceError(f"{where}: {key} must hold {expected}, got {brief(list(words))}")
    return values


def inside(where: str, name: str) -> str:
    """Return a relative path as POSIX writes it: files made on Windows have backslashes, others begin with ./.

    Raises SourceError for a path that leaves its folder, and for a text that can be no path.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[:1]:
        raise SourceError(f"{where}: {name!r} must stay inside the folder")
    if "\0" in name or any(len(part.encode("utf-8", "replace")) > 255 for part in path.parts) or len(name) > 2000:
        raise SourceError(f"{where}: {brief(name)} cannot be a path")
    return str(path)


def brief(value: Any) -> str:
    """Return a value as a message shows it."""
    if isinstance(value, int) and abs(value) >= 10**60:
        return "a number of more than 60 digits"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
