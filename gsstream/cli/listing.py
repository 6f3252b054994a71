"""Plain tables for listings: aligned columns, no colour, stable for scripts."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Sequence


def table(heading: Sequence[str], rows: Iterable[Sequence[str]], indent: str = "") -> str:
    """Return rows under a heading, every column as wide as its widest cell; the last one is not padded."""
    lines = [tuple(heading), *(tuple(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(heading))]
    padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
    return "\n".join(indent + "  ".join(cells).rstrip() for cells in padded)


def fitting(text: str) -> str:
    """Return a text whose tables fit the terminal that it is printed on; elsewhere it stays as it is."""
    from gsstream.evaluation.summary import fitted

    return fitted(text, shutil.get_terminal_size().columns) if sys.stdout.isatty() else text


def printable(text: object, keep: str = "") -> str:
    """Return a text with everything escaped that a terminal would obey, except the characters ``keep``."""
    return "".join(sign if sign.isprintable() or sign in keep else ascii(sign)[1:-1] for sign in str(text))


def plural(number: int, noun: str) -> str:
    """Return "1 part" or "2 parts"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
