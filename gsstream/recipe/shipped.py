"""Recipes of recordings that come with gsstream: ``--recipe recording:n3dv`` names one of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from gsstream.core.errors import UnknownName, suggest

SCHEME = "recording:"
#: One file for each name. ``configs/`` in the repository links to these files.
FOLDER = Path(__file__).parent / "recordings"
#: Layout of a recording -> name of the recipe of the data set that is published in this layout.
OF_LAYOUT: Mapping[str, str] = MappingProxyType(
    {"n3dv": "n3dv", "meetroom": "meetroom", "enerf": "enerf_outdoor", "panoptic": "panoptic"}
)


def names() -> list[str]:
    """Return the names that may follow ``recording:``, in order."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def recipe_file(name: str | Path, beside: Path = Path()) -> Path:
    """Return the file of a recipe.

    Arguments:
        name: ``recording:NAME``, or the path of a file.
        beside: the folder that a relative path starts from.

    Raises UnknownName for a ``recording:NAME`` that gsstream does not ship.
    """
    text = str(name)
    if not text.startswith(SCHEME):
        return beside / name
    short = text.removeprefix(SCHEME)
    if short not in names():
        near = suggest(short, names()).endswith("?")
        raise UnknownName("recipe of a recording", short, names(), f" All: {', '.join(names())}" if near else "")
    return FOLDER / f"{short}.yaml"


def label_of(path: Path) -> str | None:
    """Return how provenance names a recipe that gsstream ships, e.g. "recording n3dv"; None for another file."""
    return f"recording {path.stem}" if path.parent == FOLDER else None


def hint(path: Path) -> str:
    """Return advice when there is no file ``path`` but a recipe of that name is shipped; else an empty text."""
    return f"; a recipe of this name comes with gsstream: --recipe {SCHEME}{path.stem}" if path.stem in names() else ""
