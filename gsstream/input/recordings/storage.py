"""OpenCV's file storage: YAML with a first line and a tag of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from gsstream.core.errors import SourceError


def load_storage(path: Path) -> dict[str, Any]:
    """Read a file: a first line that YAML does not know, and matrices under a tag of their own.

    Raises SourceError for what cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # "%YAML:1.0" is no YAML directive; "- 00" in a list of names must stay a text.
        body = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
        node = YAML(typ="safe", pure=True).compose(body)
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    except YAMLError as error:
        place = str(error).splitlines()
        raise SourceError(f"{path}: not valid YAML: {place[0] if place else error}") from error
    if not isinstance(node, MappingNode):
        raise SourceError(f"{path}: expected keys with values")
    return {str(key.value): _plain(value) for key, value in node.value}


def _plain(node: Any) -> Any:
    """Texts stay texts: "00" is a name, and numbers are read where a matrix is wanted."""
    if isinstance(node, MappingNode):
        return {str(key.value): _plain(value) for key, value in node.value}
    if isinstance(node, SequenceNode):
        return [_plain(item) for item in node.value]
    return node.value if isinstance(node, ScalarNode) else None
