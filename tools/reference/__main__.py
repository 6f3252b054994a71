"""Writes the pages of docs/reference from the code: ``python -m tools.reference``, in the root of the repository."""

from __future__ import annotations

from tools.reference.pages import FOLDER, PAGES


def main() -> None:
    """Write every page."""
    for page, make in PAGES.items():
        (FOLDER / page).write_text(make(), encoding="utf-8")


if __name__ == "__main__":
    main()
