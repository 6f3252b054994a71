"""Which layout does a folder have? By its files, or by name: ``n3dv:DIR``."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsstream.core.errors import SourceError
from gsstream.input.recordings.calibration import CALIBRATION_FILE
from gsstream.input.recordings.clips import prepare_command
from gsstream.input.recordings.recorded import Recording

#: Name -> (module in ``layouts``, what it looks like).
LAYOUTS = {
    "n3dv": ("n3dv", "cam00.mp4 ... or cam00/, and poses_bounds.npy"),
    "meetroom": ("meetroom", "cam_0.mp4 ... or cam_0/, and poses_bounds.npy"),
    "enerf": ("easymocap", "intri.yml, extri.yml, images/00/"),
    "panoptic": ("panoptic", "train_meta.json, ims/"),
    "colmap": ("colmap", "sparse/0/ and images/ or videos/"),
    "nerfstudio": ("nerfstudio", "transforms.json"),
    "calibrated": ("calibrated", "videos or images/, and a calibration of Qualisys, Caliscope, ..."),
}


def _reader(name: str) -> Any:
    return importlib.import_module(f"gsstream.input.recordings.layouts.{LAYOUTS[name][0]}")


def layouts_of(folder: Path) -> list[str]:
    """Names of the layouts that the files of a folder fit."""
    return [name for name in LAYOUTS if _reader(name).looks_like(folder)]


def detect(folder: Path) -> str:
    """Name of the layout of a folder; "folder" for one with cameras.json, which always counts.

    Raises SourceError when none fits, saying what would, or when several do, saying how to choose.
    """
    if (folder / CALIBRATION_FILE).is_file():
        return "folder"
    found = layouts_of(folder)
    if len(found) == 1:
        return found[0]
    if found:
        told = "; ".join(f"{name} ({LAYOUTS[name][1]})" for name in found)
        raise SourceError(f"{folder}: the files fit several layouts: {told}. Say which: --source {found[0]}:{folder}")
    known = "; ".join(f"{name}: {looks}" for name, (_, looks) in LAYOUTS.items())
    raise SourceError(
        f"{folder}: no known layout. Expected {CALIBRATION_FILE}, or one of these: {known}. Videos or images without a "
        f"calibration: {prepare_command(str(folder))}"
    )


def read_layout(name: str, folder: Path) -> Recording:
    """Read a folder as the layout ``name``. Raises SourceError when it is none, or a faulty one."""
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected {LAYOUTS[name][1]}")
    recording: Recording = _reader(name).read(folder)
    return replace(recording, folder=folder)
