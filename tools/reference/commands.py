"""The pages of the command line and of the recipe's keys."""

from __future__ import annotations

import enum
import inspect
from collections.abc import Iterator
from typing import Any

from tools.reference.text import NOTE, cell


def cli() -> str:
    """Every command with its arguments and options."""
    from gsstream.cli.main import app
    from gsstream.cli.table import whole_table

    lines = [NOTE, "# Command line", ""]
    lines += ["Exit codes: 0 done; 2 something given is wrong; 130 interrupted; 1 other.", ""]
    for path, command in _commands(whole_table(app), "gsstream"):
        lines += [f"## {path}", "", (command.help or "").strip(), ""]
        shown = [param for param in command.params if param.name != "help"]
        if shown:
            lines += ["| argument or option | type | default | meaning |", "|---|---|---|---|"]
            for param in shown:
                name = ", ".join(param.opts) if param.param_type_name == "option" else param.name.upper()
                default = getattr(param.default, "value", param.default)
                value = "required" if param.required else "-" if default in (None, False, ()) else f"`{default}`"
                lines.append(f"| `{name}` | {_option_type(param)} | {value} | {cell(getattr(param, 'help', ''))} |")
            lines.append("")
    return "\n".join(lines)


def _option_type(param: Any) -> str:
    annotation = param.type_descriptor.annotation
    if getattr(param, "is_bool_flag", False):
        return "flag"
    if inspect.isclass(annotation) and issubclass(annotation, enum.Enum):
        kind = "one of " + ", ".join(choice.value for choice in annotation)
    else:
        kind = "path" if "Path" in str(annotation) else getattr(annotation, "__name__", str(annotation))
    return kind.replace("list", "str") + (", repeatable" if getattr(param, "multiple", False) else "")


def _commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from _commands(child, f"{path} {name}")


def recipe() -> str:
    """Every key of a recipe with type, default and meaning."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.recipe.model import Recipe

    lines = [NOTE, "# Recipe keys", "", "A part's own settings (`SLOT.params`): `gsstream plugins PART`.", ""]
    lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += [f"| `{key}` | {kind} | `{default}` | {text} |" for key, kind, default, text in setting_rows(Recipe)]
    return "\n".join(lines) + "\n"
