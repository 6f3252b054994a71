"""Every page by its file name; ``tests/test_architecture.py`` fails while one on disk differs from what is made."""

from __future__ import annotations

from tools.reference.api import api
from tools.reference.commands import cli, recipe
from tools.reference.contracts import checks, hooks, parts
from tools.reference.scenes import scene_checks
from tools.reference.text import ROOT

FOLDER = ROOT / "docs" / "reference"

PAGES = {
    "api.md": api, "checks.md": checks, "cli.md": cli, "recipe.md": recipe, "hooks.md": hooks, "parts.md": parts,
    "scene-checks.md": scene_checks,
}  # fmt: skip
