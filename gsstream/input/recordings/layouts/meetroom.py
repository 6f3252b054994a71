"""Meet Room (StreamRF): cam_0.mp4 ... cam_12.mp4 beside poses_bounds.npy; or the frames taken out of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gsstream.input.recordings.layouts.llff import POSES_FILE, camera_clips, read_poses_bounds
from gsstream.input.recordings.recorded import Recording

PATTERN = "cam_[0-9]*"


def looks_like(folder: Path) -> bool:
    """Say whether there is a poses_bounds.npy beside cam_0.mp4, cam_0/ or frame000001/cam_0.png."""
    return (folder / POSES_FILE).is_file() and any(
        any(folder.glob(pattern)) for pattern in (PATTERN, f"frame*1/{PATTERN}")
    )


def read(folder: Path) -> Recording:
    """Read Meet Room: 13 cameras, 1280 x 720, 30 frames per second; the test camera is cam_0, in the middle.

    Rows of poses_bounds.npy follow the numbers of the cameras (cam_2 before cam_10), as in StreamRF's preparation.
    """
    clips = camera_clips(folder, PATTERN)
    names = tuple(clips)
    rig = read_poses_bounds(folder / POSES_FILE, names, clips[names[0]].size)
    found = Recording(name=folder.resolve().name, where=str(folder / POSES_FILE), rig=rig, clips=clips)
    return replace(found, test=names[:1], licence="see the data set")
