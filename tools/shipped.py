"""Write ``gsstream/core/shipped.json``: which extra of gsstream brings which part, method and command of its plugins.

``python -m tools.shipped`` reads what the plugins of this repository declare, and ``pyproject.toml``. A gsstream
without these plugins reads the file to name the command that installs what is missing. A test compares the two.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

from gsstream.core.install_hints import TABLE
from gsstream.discovery.catalog import load_catalog

ROOT = Path(__file__).parents[1]


def brought_by(extras: dict[str, list[str]], extra: str) -> set[str]:
    """Return the distributions that an extra installs, those of the extras that it names included."""
    found: set[str] = set()
    for requirement in map(Requirement, extras[extra]):
        names = (brought_by(extras, name) for name in requirement.extras)
        found |= set().union(*names) if requirement.name == "gsstream" else {requirement.name}
    return found


def table() -> dict[str, list[str]]:
    """Return extra -> "KIND/NAME" of everything that no extra before it in ``pyproject.toml`` brings."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    ours = {tomllib.loads(path.read_text())["project"]["name"] for path in ROOT.glob("plugins/*/pyproject.toml")}
    found: dict[str, list[str]] = {}
    for (kind, name), entry in sorted(load_catalog().entries.items()):
        if entry.distribution in ours:
            first = next(extra for extra in extras if entry.distribution in brought_by(extras, extra))
            found.setdefault(first, []).append(f"{kind}/{name}")
    return dict(sorted(found.items()))


if __name__ == "__main__":
    TABLE.write_text(json.dumps(table(), indent=1) + "\n", encoding="utf-8")
