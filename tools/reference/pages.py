"""Every page of docs/reference that is made from the code, by its file name.

They are in the repository, so that links lead somewhere in a fresh clone and messages of the program can name them; a
test compares them with what is made.
"""

from __future__ import annotations

from pathlib import Path

from tools.reference.api import api
from tools.reference.commands import cli, recipe
from tools.reference.contracts import checks, hooks, parts
from tools.reference.scenes import scene_checks, scene_faults
from tools.reference.text import ROOT

FOLDER = ROOT / "docs" / "reference"

PAGES = {
    "api.md": api,
    "checks.md": checks,
    "cli.md": cli,
    "hooks.md": hooks,
    "parts.md": parts,
    "recipe.md": recipe,
    "scene-checks.md": scene_checks,
    "scene-faults.md": scene_faults,
}


def write(folder: Path) -> list[Path]:
    """Write every page into an existing folder, and return their paths."""
    for name, make in PAGES.items():
        (folder / name).write_text(make(), encoding="utf-8")
    return [folder / name for name in PAGES]
