"""Which layout the files of a folder fit. Imports no reader before a folder is looked at."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from gsstream.core.errors import SourceError
from gsstream.input.recordings.clips import prepare_command

#: Name -> (module in ``layouts``, what it looks like).
LAYOUTS = {
    "folder": ("declared", "cameras.json"),
    "n3dv": ("n3dv", "cam00.mp4 ... or cam00/, and poses_bounds.npy"),
    "meetroom": ("meetroom", "cam_0.mp4 ... or cam_0/, and poses_bounds.npy"),
    "enerf": ("easymocap", "intri.yml, extri.yml, images/00/"),
    "panoptic": ("panoptic", "train_meta.json, ims/"),
    "colmap": ("colmap", "sparse/0/ and images/ or videos/"),
    "nerfstudio": ("nerfstudio", "transforms.json"),
    "calibrated": ("calibrated", "videos or images/, and a calibration of Qualisys, Caliscope, ..."),
}


def reader(name: str) -> Any:
    """Return the module that reads a layout."""
    return importlib.import_module(f"gsstream.input.recordings.layouts.{LAYOUTS[name][0]}")


def layouts_of(folder: Path) -> list[str]:
    """Return the names of the layouts that the files of a folder fit; "folder" alone where there is a cameras.json."""
    if reader("folder").looks_like(folder):
        return ["folder"]
    return [name for name in LAYOUTS if reader(name).looks_like(folder)]


def detect(folder: Path) -> str:
    """Return the name of the layout of a folder; "folder" for one with cameras.json, which always counts.

    Raises SourceError when none fits, saying what would, or when several do, saying how to choose.
    """
    found = layouts_of(folder)
    if len(found) == 1:
        return found[0]
    if found:
        listed = "; ".join(f"{name} ({LAYOUTS[name][1]})" for name in found)
        raise SourceError(f"{folder}: the files fit several layouts: {listed}. Say which: --source {found[0]}:{folder}")
    known = "; ".join(f"{name}: {looks}" for name, (_, looks) in LAYOUTS.items())
    raise SourceError(
        f"{folder}: no known layout. Expected one of these: {known}. Videos or images without a "
        f"calibration: {prepare_command(str(folder))}"
    )
