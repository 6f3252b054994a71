"""A resolved recipe as YAML, with the provenance of every value beside it."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from gsstream.recipe.document import KeyPath
from gsstream.recipe.load import ResolvedRecipe, recipe_hash


def to_yaml(resolved: ResolvedRecipe) -> str:
    """YAML text that ``load_recipe`` reads back to an equal recipe."""
    yaml = YAML()
    yaml.width = 10_000
    yaml.representer.add_representer(type(None), lambda r, _: r.represent_scalar("tag:yaml.org,2002:null", "null"))
    stream = io.StringIO()
    yaml.dump(_annotate(resolved.recipe.model_dump(mode="json"), (), resolved), stream)
    heading = f"# Resolved recipe {recipe_hash(resolved.recipe)}\n# Beside every value: where it comes from.\n"
    return heading + _align(stream.getvalue())


def save_resolved(path: Path, resolved: ResolvedRecipe) -> None:
    """Write ``to_yaml(resolved)`` to ``path``."""
    path.write_text(to_yaml(resolved), encoding="utf-8")


def leaves_of(tree: Mapping[str, Any], path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """(path, value) of everything that is not a mapping, in order."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves_of(value, (*path, key))
        else:
            yield (*path, key), value


def _annotate(tree: Mapping[str, Any], path: KeyPath, resolved: ResolvedRecipe) -> CommentedMap:
    out = CommentedMap()
    for key, value in tree.items():
        here = (*path, key)
        if isinstance(value, Mapping) and value:
            out[key] = _annotate(value, here, resolved)
            continue
        out[key] = _flow(value)
        out.yaml_add_eol_comment(resolved.origin(here).label.replace("\n", " "), key, column=0)
    return out


def _flow(value: Any) -> Any:
    """Lists and empty mappings on one line, so that a comment can stand behind them."""
    out: Any
    if isinstance(value, list):
        out = CommentedSeq([_flow(item) for item in value])
    elif isinstance(value, Mapping):
        out = CommentedMap({key: _flow(item) for key, item in value.items()})
    else:
        return value
    out.fa.set_flow_style()
    return out


def _align(text: str) -> str:
    """Put the provenance comments in one column."""
    lines = [line.rpartition(" # ") for line in text.splitlines()]
    width = max((len(head.rstrip()) for head, mark, _ in lines if mark and len(head.rstrip()) < 60), default=0)
    return "\n".join(f"{head.rstrip():<{width}}  # {tail}" if mark else tail for head, mark, tail in lines) + "\n"
