"""The page of the checks of scenes, with what they say about the bad scenes of the tests."""

from __future__ import annotations

import importlib
import json
import sys

from tools.reference.text import NOTE, ROOT


def scene_checks() -> str:
    """Every check of ``scene validate``, and what it says about the bad scenes of the tests."""
    from gsstream.input.prepare.findings import CHECKS

    sys.path.insert(0, str(ROOT))
    try:
        table = importlib.import_module("tests.input.prepare.bad_scenes")
    finally:
        sys.path.remove(str(ROOT))
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
