"""Writes the pages of this folder from the code, so that they cannot drift: ``python docs/reference/generate.py``.

``tests/test_architecture.py`` fails while a page on disk differs from what this module makes.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
NOTE = "<!-- Made by docs/reference/generate.py from the code. Do not edit. -->\n"


def exported() -> dict[str, Any]:
    """Every public name of gsstream.api, modules left out."""
    import gsstream.api

    names = {name: value for name, value in vars(gsstream.api).items() if not name.startswith("_")}
    return {name: names[name] for name in sorted(names, key=str.lower) if not inspect.ismodule(names[name])}


def api() -> str:
    """One line per exported name, with its signature."""
    lines = [NOTE, "# gsstream.api", "", "Everything a plugin or a script may import.", ""]
    lines += ["| name | what it is | defined in |", "|---|---|---|"]
    for name, value in exported().items():
        described = inspect.isclass(value) or inspect.isroutine(value)
        text = (inspect.getdoc(value) or "").splitlines()[0] if described else f"constant, `{value!r}`"
        module = getattr(value, "__module__", "gsstream") if described else "-"
        lines.append(f"| `{name}` | {text.replace('|', chr(92) + '|')} | `{module}` |")
    return "\n".join(lines) + "\n"


def cli() -> str:
    """Every command with its arguments and options."""
    from typer.main import get_command

    from gsstream.cli.main import app

    lines = [NOTE, "# Command line", ""]
    lines += ["Exit codes: 0 done; 2 something given is wrong; 130 interrupted; 1 other.", ""]
    for path, command in _commands(get_command(app), "gsstream"):
        lines += [f"## {path}", "", (command.help or "").strip(), ""]
        shown = [param for param in command.params if param.name != "help"]
        if shown:
            lines += ["| argument or option | meaning |", "|---|---|"]
            for param in shown:
                name = ", ".join(param.opts) if param.param_type_name == "option" else param.name.upper()
                lines.append(f"| `{name}` | {getattr(param, 'help', '')} |")
            lines.append("")
    return "\n".join(lines)


def _commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from _commands(child, f"{path} {name}")


def recipe() -> str:
    """Every key of a recipe with type, default and meaning."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.recipe.model import Recipe

    lines = [NOTE, "# Recipe keys", "", "A part's own settings (`SLOT.params`): `gsstream plugins show PART`.", ""]
    lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += [f"| `{key}` | {kind} | `{default}` | {text} |" for key, kind, default, text in setting_rows(Recipe)]
    return "\n".join(lines) + "\n"


def checks() -> str:
    """Every check of the contract kit, the claim that calls for it, and the saboteur that proves it can fail."""
    from gsstream.testing.kit import all_checks
    from gsstream.testing.saboteurs import saboteur_of

    lines = [NOTE, "# Checks of the contract kit", ""]
    lines += [
        "What every part promises. `gsstream check NAME` makes the checks of a part, a plugin or a method;",
        "`gsstream.testing.parametrize_with_checks` makes one test of each. A check with a claim is made on parts",
        "whose traits claim it, and is otherwise skipped and counted. Each check has a saboteur: a "
        "part that is wrong in one",
        "way and fails this check alone: [the whole table](saboteurs.md).",
        "",
    ]
    kinds = list(dict.fromkeys(entry.kind for entry in all_checks()))
    for kind in kinds:
        lines += [f"## {kind}", "", "| check | meaning | claim | saboteur |", "|---|---|---|---|"]
        for entry in all_checks():
            if entry.kind == kind:
                claim = f"`{entry.trait}`" if entry.trait else "-"
                meaning = entry.meaning.replace("|", chr(92) + "|")
                lines.append(f"| `{entry.name}` | {meaning} | {claim} | {saboteur_of(entry.name)} |")
        lines.append("")
    return "\n".join(lines)


#: What a cell of the table check x saboteur says.
MARKS = {"failed": "✗", "passed": "·", "skipped": "–"}


def saboteur_columns() -> dict[str, dict[str, Any]]:
    """kind -> the check that a saboteur is to fail -> how to make its column (the results of all checks on it)."""
    from gsstream.testing.kit import run_checks, run_packet_checks, run_subject
    from gsstream.testing.registry import kind_of
    from gsstream.testing.saboteurs import METHOD_SABOTEURS, PACKET_SABOTEURS, SABOTEURS

    columns: dict[str, dict[str, Any]] = {}
    for check, cls in SABOTEURS.items():
        columns.setdefault(kind_of(cls()), {})[check] = lambda cls=cls: run_checks(cls())
    columns["method"] = {
        check: lambda cls=cls: run_subject("method", cls("dense")) for check, cls in METHOD_SABOTEURS.items()
    }
    columns["packet"] = {
        check: lambda codec=codec: run_packet_checks(codec) for check, codec in PACKET_SABOTEURS.items()
    }
    return columns


def saboteurs() -> str:
    """The table check x saboteur, made by making every check on every saboteur (slow: about a minute)."""
    from gsstream.testing.saboteurs import saboteur_of

    lines = [NOTE.replace("generate.py", "generate.py --saboteurs"), "# Checks against saboteurs", ""]
    lines += [
        "A check that cannot fail proves nothing. For each there is a saboteur, a part that is wrong in one way.",
        "Rows: every check that is made on this kind; columns: the saboteurs of this kind. ✗ fails, · passes,",
        "– is skipped (not claimed). Every column has one ✗. `tests/contract/test_saboteurs.py` makes all of it anew",
        "and holds it against this page.",
        "`check_cheap_spec` has a saboteur that must be installed: a plugin whose declaration imports torch.",
        "",
    ]
    for kind, columns in saboteur_columns().items():
        results = {check: make() for check, make in columns.items()}
        lines += [f"## {kind}", "", f"| check | {' | '.join(str(n) for n in range(1, len(results) + 1))} |"]
        lines.append("|---" * (len(results) + 1) + "|")
        for row, result in enumerate(next(iter(results.values()))):
            marks = " | ".join(MARKS[column[row].status] for column in results.values())
            lines.append(f"| `{result.check}` | {marks} |")
        lines.append("")
        lines += [f"{n}. for `{check}`: {saboteur_of(check)}" for n, check in enumerate(results, 1)]
        lines.append("")
    return "\n".join(lines)


PAGES = {"api.md": api, "checks.md": checks, "cli.md": cli, "recipe.md": recipe}

if __name__ == "__main__":
    if "--saboteurs" in sys.argv:
        (HERE / "saboteurs.md").write_text(saboteurs(), encoding="utf-8")
    for page, make in PAGES.items():
        (HERE / page).write_text(make(), encoding="utf-8")
