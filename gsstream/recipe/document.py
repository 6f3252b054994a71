"""Recipe text -> leaves: every value with its path and the place it was written.

YAML 1.2 through ruamel.yaml: ``1e-3`` is a number, ``on`` is a word, a key given twice is an error.
"""

from __future__ import annotations

import itertools
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from gsstream.core.errors import RecipeError
from gsstream.recipe.shipped import hint

KeyPath = tuple[str, ...]
#: Bytes of a recipe file; a whole recipe with all its settings has about 5 KB.
LONGEST = 200_000
#: Lists within lists; and values, as the signs between them say: a reader of YAML takes a second for ten thousand.
DEEPEST, MOST_VALUES = 100, 5_000
#: Keys that hold lists of names. What stands in them is text, so that a camera may be called 0012.
NAMES = (("data", "test_cameras"), ("data", "train_cameras"))
_BETWEEN = re.compile(r"[,\r\n]|[-?:][ \t]")
_NESTING = {"[": 1, "{": 1, "]": -1, "}": -1}


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a value comes from."""

    label: str  # provenance, as printed beside the value: "default", "method s2gs", "file run.yaml:6", "command line"
    where: str  # prefix of error messages: "run.yaml:6:5", "--set gate.temperature=0.3"


DEFAULT = Origin("default", "default")


@dataclass(frozen=True, slots=True)
class Leaf:
    """A value that is not a mapping, and where it was written."""

    value: Any
    origin: Origin


class Empty:
    """Stands for a mapping without entries: it sets nothing, but its key must still be known."""


class Section:
    """Stands for a mapping with entries while a file is being read."""


@dataclass(frozen=True, slots=True)
class Layer:
    """The leaves of one file or of the command line, in the order they were written."""

    leaves: Mapping[KeyPath, Leaf]  # path -> leaf
    #: Path -> origin of every key, those of sections too, where the place is known.
    marks: Mapping[KeyPath, Origin] = field(default_factory=dict)
    shorthand: bool = False  # whether ``gate.temperature`` may stand for ``gate.params.temperature``

    def where(self, path: KeyPath, leaf: Leaf) -> str:
        """Place of the key at ``path``, one of the keys that lead to ``leaf``."""
        return self.marks.get(path, leaf.origin).where


def read_file(path: Path, label: str | None = None) -> Layer:
    """Read a YAML file as a layer. Raises RecipeError for invalid YAML, a key given twice, an anchor."""
    return _layer(_text_of(path), str(path), label)


@lru_cache(maxsize=64)  # a sweep resolves the same few files for every one of its cells
def _layer(text: str, name: str, label: str | None) -> Layer:
    root = _compose(text, name)
    if root is None:
        return Layer({})
    if not isinstance(root, MappingNode):
        raise RecipeError(f"{_where(root, name)}: a recipe maps keys to values; got a single value or a list")

    def origin(node: Node) -> Origin:
        return Origin(label or f"file {name}:{node.start_mark.line + 1}", _where(node, name))

    marks: dict[KeyPath, Origin] = {}
    leaves: dict[KeyPath, Leaf] = {}
    for key, node, value in _walk(root, (), name):
        marks[key] = origin(node)
        if not isinstance(value, Section):
            leaves[key] = Leaf(value, marks[key])
    return Layer(MappingProxyType(leaves), MappingProxyType(marks))


def _text_of(path: Path) -> str:
    """The text of a file, of which no more is read than a recipe can have: ``path`` may be a device without an end."""
    try:
        with path.open("rb") as file:
            content = file.read(LONGEST + 1)
        if len(content) > LONGEST:
            raise RecipeError(f"{path}: expected at most {LONGEST // 1000} KB of YAML, as a recipe has; got more")
        return content.decode("utf-8")
    except FileNotFoundError as error:
        raise RecipeError(f"cannot read the recipe {path}: {error}{hint(path)}") from error
    except (OSError, ValueError) as error:  # ValueError: no UTF-8, or a name with a NUL
        if isinstance(error, RecipeError):
            raise
        raise RecipeError(f"cannot read the recipe {path}: {error}") from error


def is_file(path: Path) -> bool:
    """Say whether there is such a file; of a name that no file can have, there is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def read_override(text: str, option: str = "--set") -> tuple[KeyPath, Leaf]:
    """Read one ``a.b=value`` of the command line; the value is YAML. Raises RecipeError."""
    where = f"{option} {text}"
    key, equals, value = text.partition("=")
    path = tuple(key.strip().split("."))
    if not equals or not all(path) or not value.strip():
        raise RecipeError(f"{where}: expected KEY.PATH=VALUE, e.g. --set stream.epochs=10 (write null for 'absent')")
    node = _compose(value, where)
    assert node is not None, "a non-blank text composes to a node or raises"
    names = _names(node) if path in NAMES else None
    return path, Leaf(names or _plain(node, where, located=False), Origin("command line", where))


def _compose(text: str, name: str) -> Node | None:
    deepest = max(itertools.accumulate(_NESTING.get(sign, 0) for sign in text), default=0)
    if deepest > DEEPEST:  # the parser would find out, too, after a minute
        raise RecipeError(f"{name}: not valid YAML: nested too deeply")
    values = len(_BETWEEN.findall(text))
    if values > MOST_VALUES:
        raise RecipeError(f"{name}: expected at most {MOST_VALUES} values, as a recipe has; got about {values}")
    try:
        return YAML(typ="safe", pure=True).compose(text)  # type: ignore[no-any-return]
    except MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        raise RecipeError(f"{place}: not valid YAML: {error.problem or error.context}") from error
    except (YAMLError, ValueError) as error:
        raise RecipeError(f"{name}: not valid YAML: {error}") from error
    except RecursionError as error:
        raise RecipeError(f"{name}: not valid YAML: nested too deeply") from error


def _where(node: Node, name: str) -> str:
    return f"{name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"


def _walk(mapping: MappingNode, path: KeyPath, name: str) -> Iterator[tuple[KeyPath, Node, Any]]:
    """(path, key node, value) of every key below a mapping, a section before its keys."""
    seen: dict[str, Node] = {}
    _refuse_anchor(mapping, _where(mapping, name))
    for key_node, node in mapping.value:
        if not isinstance(key_node, ScalarNode) or not str(key_node.tag).endswith(":str"):
            got = getattr(key_node, "value", "?")
            raise RecipeError(f"{_where(key_node, name)}: a key must be a word, got {got!r}")
        key = key_node.value
        if key in seen:
            raise RecipeError(
                f"{_where(key_node, name)}: key {'.'.join((*path, key))!r} is given twice, first in line "
                f"{seen[key].start_mark.line + 1}"
            )
        seen[key] = key_node
        if isinstance(node, MappingNode) and node.value:
            yield (*path, key), key_node, Section()
            yield from _walk(node, (*path, key), name)
        elif isinstance(node, MappingNode):
            yield (*path, key), key_node, Empty()
        else:
            names = _names(node) if (*path, key) in NAMES else None
            yield (*path, key), key_node, names or _plain(node, name)


def _names(node: Node) -> list[str] | None:
    """The texts of a list of plain scalars as they are written; None: it is something else."""
    items = node.value if isinstance(node, SequenceNode) else []
    plain = all(isinstance(item, ScalarNode) and not item.anchor for item in items)
    return [str(item.value) for item in items] if plain and not node.anchor else None


def _plain(node: Node, name: str, *, located: bool = True) -> Any:
    """A node as a JSON value."""
    where = _where(node, name) if located else name
    _refuse_anchor(node, where)
    if isinstance(node, SequenceNode):
        return [_plain(item, name, located=located) for item in node.value]
    if isinstance(node, MappingNode):
        return {str(key.value): _plain(value, name, located=located) for key, value in node.value}
    try:
        value = YAML(typ="safe", pure=True).constructor.construct_object(node)
    except (YAMLError, ValueError, ArithmeticError, LookupError, TypeError) as error:
        # The text does not hold a value of the type in its tag: !!int abc, !foo, an integer of five thousand digits.
        reason = getattr(error, "problem", None) or str(error)
        raise RecipeError(f"{where}: {textwrap.shorten(str(node.value), 60)!r} has no plain value: {reason}") from error
    if value is not None and not isinstance(value, str | bool | int | float):
        raise RecipeError(f"{where}: {node.value!r} reads as a {type(value).__name__}; quote it if a word is meant")
    if isinstance(value, float) and not math.isfinite(value):
        raise RecipeError(f"{where}: expected a finite number, got {node.value}")
    if isinstance(value, int) and value.bit_length() > 63:
        raise RecipeError(f"{where}: expected a whole number of at most 63 bits, got one of {value.bit_length()}")
    return value


def _refuse_anchor(node: Node, where: str) -> None:
    if node.anchor:
        raise RecipeError(f"{where}: anchors and aliases (&{node.anchor}) are not used in recipes; write the value out")
