"""Write the pages of docs/reference that are made from the code: ``make docs``, or ``python -m tools.reference``."""

from __future__ import annotations

import argparse

from tools.reference.pages import FOLDER, write


def main() -> None:
    """Write every page into docs/reference; ``--help`` writes none."""
    argparse.ArgumentParser(prog="python -m tools.reference", description=__doc__).parse_args()
    for path in write(FOLDER):
        print(path)


if __name__ == "__main__":
    main()
