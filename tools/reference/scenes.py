"""The pages of what is wrong with scenes: their checks, and kinds of fault by reader, both as the tests have them."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

from tools.reference.text import NOTE, ROOT

#: What becomes of a recording with a fault.
VERDICTS = {
    "right": "read as the sound recording is",
    "warned": "read; a warning says what is left out, has no effect or was brought to another size",
    "refused": "not read; one sentence says what is wrong and what to do",
    "does not apply": "the format cannot have this fault",
}


def _of_tests(name: str) -> Any:
    sys.path.insert(0, str(ROOT))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(ROOT))


def scene_faults() -> str:
    """What becomes of every kind of fault in every format."""
    cells = json.loads((ROOT / "tests" / "input" / "faults" / "cells.json").read_text(encoding="utf-8"))
    count = sum(verdict != "does not apply" for row in cells.values() for verdict, _ in row.values())
    lines = [NOTE, "# Faults of recordings", ""]
    lines += [
        f"What becomes of a recording with a fault, by format. The tests make these {count} recordings, read each",
        "as `run`, `scene validate` and `scene prepare` do (and `watch:`, where it applies), and compare cameras,",
        "instants, rate and poses with those of the sound recording, and what is said between the commands.",
        "",
        *(f"- *{verdict}*: {meaning}." for verdict, meaning in VERDICTS.items()),
        "",
    ]
    for fault, row in cells.items():
        lines += [f"## {fault[0].upper()}{fault[1:]}", "", "| outcome | formats | for example |", "|---|---|---|"]
        for verdict in VERDICTS:
            words = {name: words for name, (found, words) in row.items() if found == verdict}
            if words:
                least = min(words.values(), key=len).replace("|", "\\|")
                shown = "all others" if len(words) > len(row) / 2 else "; ".join(words)
                lines.append(f"| {verdict} | {shown} | {least} |")
        lines.append("")
    return "\n".join(lines)


def scene_checks() -> str:
    """Every check of ``scene validate``, and what it says about the bad scenes of the tests."""
    from gsstream.input.prepare.findings import CHECKS

    table = _of_tests("tests.input.prepare.bad_scenes")
    messages = json.loads(table.MESSAGES.read_text(encoding="utf-8"))
    lines = [NOTE, "# Checks of scenes", ""]
    lines += [
        "`gsstream scene validate SCENE` makes these checks in this order and stops at the first stage with an error,",
        "so that one fault gives one message. Below each check: the bad scenes that the tests make of a good one, with",
        "what is said about them.",
        "",
    ]
    for code, meaning in CHECKS.items():
        lines += [f"## {code}", "", f"{meaning[0].upper()}{meaning[1:]}.", "", "| wrong | message |", "|---|---|"]
        rows = [(bad.fault, messages[bad.name]) for bad in table.BAD if bad.code == code]
        lines += [f"| {fault} | {' '.join(said).replace('|', chr(92) + '|')} |" for fault, said in rows]
        lines.append("")
    return "\n".join(lines)
