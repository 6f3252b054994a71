"""A public name that goes raises the number of the interface.

``python tests/core/test_public_names.py`` writes the list of the names that plugins and scripts may import, with the
number of the interface that they belong to.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

from gsstream import API_VERSION

LIST = Path(__file__).with_name("public_names.json")
DOORS = ("api", "backend", "blocks", "encode", "play", "replay", "spec", "testing")


def public_names() -> dict[str, list[str]]:
    """Return door -> the names that it exports: those of its ``__all__``, or where it has none all that it defines."""
    found = {}
    for door in DOORS:
        module = importlib.import_module(f"gsstream.{door}")
        listed = getattr(module, "__all__", vars(module))
        found[door] = sorted(
            name
            for name, value in vars(module).items()
            if name in listed
            and not name.startswith("_")
            and type(value).__name__ != "module"
            and name != "annotations"
            and (getattr(value, "__module__", "gsstream") or "").startswith("gsstream")
        )
    return found


def test_names_that_went_raised_the_number() -> None:
    listed, now = json.loads(LIST.read_text(encoding="utf-8")), public_names()
    gone = {door: sorted(set(names) - set(now[door])) for door, names in listed["names"].items()}
    gone = {door: names for door, names in gone.items() if names}
    was, current = (int(version.partition(".")[0]) for version in (listed["version"], API_VERSION))
    assert not gone or current > was, (
        f"{gone} can no longer be imported, and the interface is still {API_VERSION}: raise API_VERSION to {was + 1}.0 "
        f"in gsstream/__init__.py, then write the list anew: python {Path(__file__).name}"
    )
    assert now == listed["names"], f"the list is out of date: write it anew with python {Path(__file__).name}"
    assert listed["version"] == API_VERSION, f"write the list anew with python {Path(__file__).name}"


if __name__ == "__main__":
    text = json.dumps({"version": API_VERSION, "names": public_names()}, indent=1)
    LIST.write_text(text + "\n", encoding="utf-8")
