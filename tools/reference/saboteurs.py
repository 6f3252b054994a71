"""The table check x saboteur. It takes about a minute, so it is a page of its own option."""

from __future__ import annotations

from typing import Any

from tools.reference.text import NOTE

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

    lines = [NOTE.replace("tools.reference", "tools.reference --saboteurs"), "# Checks against saboteurs", ""]
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
