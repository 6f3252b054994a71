"""The vertices of a PLY file: ascii or little-endian binary, with other elements before or behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
#: Longest header that is read; a file without an end of header is not a PLY.
_HEADER_LIMIT = 65536


@dataclass(frozen=True, slots=True)
class Vertices:
    """One row per vertex."""

    table: np.ndarray[Any, Any]  # [P] structured, of the types that the header states
    comments: tuple[tuple[str, ...], ...]  # the words of each comment


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]
    lists: bool = False  # a property is a list, so that rows differ in length


def read_vertices(data: bytes) -> Vertices:
    """Return the element ``vertex`` of a PLY file.

    Raises ValueError saying what is wrong: not a PLY, big-endian, no such element, cut short.
    """
    end = data[:_HEADER_LIMIT].find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("not a PLY file; expected a header from 'ply' to 'end_header'")
    body = data.find(b"\n", end) + 1
    lines = [tuple(line.split()) for line in data[:end].decode("ascii", "replace").splitlines()]
    encoding = next((line[1] for line in lines if line[:1] == ("format",) and len(line) > 1), "")
    if encoding not in ("ascii", "binary_little_endian") or not body:
        raise ValueError(f"format {encoding!r}; expected ascii or binary_little_endian")
    elements = _elements(lines)
    place = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise ValueError("its header has no 'element vertex COUNT'")
    vertex, before = elements[place], elements[:place]
    if vertex.lists or not vertex.fields or len(dict(vertex.fields)) < len(vertex.fields):
        raise ValueError("its header has a vertex property that is not a plain number, is there twice, or none at all")
    comments = tuple(line[1:] for line in lines if line[:1] == ("comment",))
    read = _text if encoding == "ascii" else _binary
    return Vertices(read(data[body:], before, vertex), comments)


def _elements(lines: list[tuple[str, ...]]) -> list[_Element]:
    elements: list[_Element] = []
    for words in lines:
        if words[:1] == ("element",):
            if len(words) != 3 or not words[2].isdigit():
                raise ValueError(f"its header has the line {' '.join(words)!r}; expected a name and a count")
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ("property",) and elements:
            if len(words) == 3 and words[1] in _TYPES:
                elements[-1].fields.append((words[2], _TYPES[words[1]]))
            else:
                elements[-1].lists = True
    return elements


def _binary(body: bytes, before: list[_Element], vertex: _Element) -> np.ndarray[Any, Any]:
    if any(element.lists and element.count for element in before):
        raise ValueError("an element with lists stands before the vertices, which is not supported in a binary file")
    start = sum(element.count * np.dtype(element.fields).itemsize for element in before if element.count)
    dtype = np.dtype(vertex.fields)
    needed = vertex.count * dtype.itemsize
    if len(body) - start < needed:
        raise ValueError(f"cut short: expected {needed} bytes of vertices, got {max(0, len(body) - start)}")
    return np.frombuffer(body, dtype, vertex.count, start)


def _text(body: bytes, before: list[_Element], vertex: _Element) -> np.ndarray[Any, Any]:
    start = sum(element.count for element in before)
    rows = body.decode("ascii", "replace").split("\n")[start : start + vertex.count]
    rows = rows if rows and rows[-1].strip() else rows[:-1]
    if len(rows) < vertex.count:
        raise ValueError(f"the rows cannot be read: {vertex.count} rows are announced, {len(rows)} are there")
    numbers = np.empty((vertex.count, len(vertex.fields)))
    for i, row in enumerate(rows):
        try:
            numbers[i] = [float(word) for word in row.split()]
        except ValueError as error:
            raise ValueError(f"the rows cannot be read: vertex {i}: {error}") from error
    table = np.empty(vertex.count, np.dtype(vertex.fields))
    for column, (name, kind) in zip(numbers.T, vertex.fields, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            table[name] = column
        if np.dtype(kind).kind in "iu" and (table[name] != column).any():
            at = int((table[name] != column).argmax())
            raise ValueError(
                f"the rows cannot be read: vertex {at}: {column[at]:g} is no whole number of the type of {name}"
            )
    return table
