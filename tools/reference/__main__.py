"""Writes the pages of docs/reference from the code: ``python -m tools.reference``, in the root of the repository.

``--saboteurs`` makes the slow page too, every check on every saboteur (about a minute).
"""

from __future__ import annotations

import argparse

from tools.reference.pages import FOLDER, PAGES
from tools.reference.saboteurs import saboteurs


def main() -> None:
    """Write every page."""
    parser = argparse.ArgumentParser(prog="python -m tools.reference", description=__doc__)
    parser.add_argument("--saboteurs", action="store_true", help="the page of saboteurs too")
    if parser.parse_args().saboteurs:
        (FOLDER / "saboteurs.md").write_text(saboteurs(), encoding="utf-8")
    for page, make in PAGES.items():
        (FOLDER / page).write_text(make(), encoding="utf-8")


if __name__ == "__main__":
    main()
