"""The page of the front doors of scripts and plugins: every exported name with its signature."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.reference.text import NOTE, cell, signature

#: The modules that scripts and plugins may import, and who they are for.
DOORS = {
    "api": "What a plugin imports: records and contracts. Imports torch.",
    "backend": "What a renderer imports, and what it may bring: a loss and a row optimiser. Imports torch.",
    "blocks": "Functions that the engine itself is built from, for methods of other kinds. Imports torch.",
    "encode": "What a script imports to encode: frames in, packets out. Imports torch.",
    "play": "What a script imports to play: packets in, Gaussians and pictures out. Imports no torch.",
}


def exported(door: str = "api") -> dict[str, Any]:
    """Every public name of a door: what it imports under its own name, and what it defines."""
    module = importlib.import_module(f"gsstream.{door}")
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    imported = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    names = {alias.asname for alias in imported if alias.asname == alias.name}
    names |= {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return {name: getattr(module, name) for name in sorted(names - {None}, key=str.lower) if not name.startswith("_")}


def api() -> str:
    """Every exported name of every door: one line in a table, then its exact signature, fields and methods."""
    lines = [NOTE, "# Python names", "", "Everything that a plugin or a script may import.", ""]
    for door, use in DOORS.items():
        lines += [f"## gsstream.{door}", "", use, "", "| name | what it is | defined in |", "|---|---|---|"]
        lines += [_row(name, value) for name, value in exported(door).items()]
        lines.append("")
    lines += ["## Signatures", ""]
    everything = {name: value for door in DOORS for name, value in exported(door).items()}
    for name in sorted(everything, key=str.lower):
        value = everything[name]
        if inspect.isclass(value) or inspect.isroutine(value):
            lines += [f"### {name}", "", "```python", *_declared(name, value), "```", "", *_meanings(value)]
    return "\n".join(lines)


def _meanings(value: Any) -> list[str]:
    """The section ``Arguments`` of a docstring as a list: what each field or argument means."""
    section = re.search(r"^Arguments:\n(.*?)(?=^\S|\Z)", inspect.getdoc(value) or "", re.MULTILINE | re.DOTALL)
    if section is None:
        return []
    entries = re.split(r"\n(?=\S)", inspect.cleandoc(section[1]))
    named = [re.fullmatch(r"([\w, *]+): (.*)", " ".join(entry.split())) for entry in entries]
    return [*(f"- `{found[1]}`: {found[2]}" for found in named if found is not None), ""]


def _row(name: str, value: Any) -> str:
    described = inspect.isclass(value) or inspect.isroutine(value)
    text = (inspect.getdoc(value) or "").splitlines()[0] if described else f"constant, `{value!r}`"
    module = getattr(value, "__module__", "gsstream") if described else "-"
    return f"| `{name}` | {cell(text)} | `{module}` |"


def _declared(name: str, value: Any) -> Iterator[str]:
    """A function's signature; of a class how it is made, its fields and its public methods, inherited ones too."""
    if not inspect.isclass(value):
        yield f"def {signature(name, value)}"
        return
    bases = ", ".join(base.__name__ for base in value.__bases__ if base is not object)
    yield f"class {name}({bases}):" if bases else f"class {name}:"
    for field, kind in _fields(value):
        yield f"    {field}: {kind}"
    made = dataclasses.is_dataclass(value) or "__init__" in vars(value)
    if made and not getattr(value, "_is_protocol", False):
        yield f"    def {signature('__init__', value.__init__)}"
    for method, member in _members(value):
        function = getattr(member, "fget", None) or getattr(member, "__func__", member)
        if isinstance(member, property | staticmethod | classmethod):
            yield f"    @{type(member).__name__}"
        if getattr(member, "__isabstractmethod__", False):
            yield "    @abstractmethod"
        yield f"    def {signature(method, function)}"


def _fields(value: type) -> Iterator[tuple[str, str]]:
    """Annotated names of a class that are no constructor arguments told anyway: those of parts, protocols, errors."""
    if dataclasses.is_dataclass(value):
        return
    for field, kind in inspect.get_annotations(value).items():
        if not field.startswith("_"):
            # Named tuples keep annotations as forward references.
            yield field, kind if isinstance(kind, str) else getattr(kind, "__forward_arg__", str(kind))


def _members(value: type) -> Iterator[tuple[str, Any]]:
    """Public functions and properties by name, in the order in which classes declare them, the nearest class first."""
    seen: set[str] = set()
    for cls in value.__mro__:
        if not cls.__module__.startswith("gsstream"):
            continue
        for name, member in vars(cls).items():
            known = isinstance(member, property | staticmethod | classmethod) or inspect.isfunction(member)
            if known and not name.startswith("_") and name not in seen:
                seen.add(name)
                yield name, member
