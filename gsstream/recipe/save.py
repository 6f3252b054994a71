"""A resolved recipe as YAML, with the provenance of every value beside it."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from gsstream.recipe.document import KeyPath
from gsstream.recipe.load import ResolvedRecipe, recipe_hash


def to_yaml(resolved: ResolvedRecipe) -> str:
    """Return YAML text that ``load_recipe`` reads back to an equal recipe."""
    heading = f"# Resolved recipe {recipe_hash(resolved.recipe)}\n# Beside every value: where it comes from.\n"
    return heading + values_to_yaml(resolved.recipe.model_dump(mode="json"), resolved)


def values_to_yaml(values: Mapping[str, Any], resolved: ResolvedRecipe) -> str:
    """Return YAML text of some of a recipe's sections, with the provenance of every value beside it."""
    widths = [len(line) for line in _dump(_tree(values, (), None, 0)).split("\n")]
    column = 2 + max((width for width in widths if width < 60), default=0)
    return _dump(_tree(values, (), resolved, column))


def save_resolved(path: Path, resolved: ResolvedRecipe) -> None:
    """Write ``to_yaml(resolved)`` to ``path``."""
    path.write_text(to_yaml(resolved), encoding="utf-8")


def _dump(tree: CommentedMap) -> str:
    yaml = YAML()
    yaml.width = 1_000_000  # a value stays on the line of its comment
    yaml.representer.add_representer(type(None), lambda r, _: r.represent_scalar("tag:yaml.org,2002:null", "null"))
    stream = io.StringIO()
    yaml.dump(tree, stream)
    return stream.getvalue()


def _tree(values: Mapping[str, Any], path: KeyPath, resolved: ResolvedRecipe | None, column: int) -> CommentedMap:
    """The values as ruamel's round-trip mapping, each leaf with its provenance as a comment at ``column``."""
    out = CommentedMap()
    for name, value in values.items():
        here, key = (*path, name), _inline(name)
        if isinstance(value, Mapping) and value:
            out[key] = _tree(value, here, resolved, column)
            continue
        out[key] = _inline(value)
        if resolved is not None:
            label = " ".join(resolved.origin(here).label.split())
            out.yaml_add_eol_comment(label, key, column=column)
    return out


def _inline(value: Any) -> Any:
    """A value on one line, so that a comment can stand behind it."""
    out: Any
    if isinstance(value, str):
        # Plain words stay plain. Anything else is quoted: in a list, "?0" without quotes would read as a key.
        return value if re.fullmatch(r"[A-Za-z][\w.-]*", value, re.ASCII) else DoubleQuotedScalarString(value)
    if isinstance(value, list):
        out = CommentedSeq([_inline(item) for item in value])
    elif isinstance(value, Mapping):
        out = CommentedMap({_inline(key): _inline(item) for key, item in value.items()})
    else:
        return value
    out.fa.set_flow_style()
    return out
