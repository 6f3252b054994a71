"""Calibrations of real rigs, as the programs wrote them: every camera looks at what all of them look at."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.sync import RecordingWarning

EXPORTS = Path(__file__).parent / "exports"
#: File -> (pictures' size per camera, an eighth of the calibration's; cameras without a pose).
FILES: dict[str, tuple[dict[str, tuple[int, int]], tuple[str, ...]]] = {
    "caliscope/camera_array.toml": ({f"cam_{i}": (160, 90) for i in range(4)}, ()),
    "caliscope/vectors.toml": ({f"cam_{i}": (240, 135) for i in range(1, 12)}, ()),
    "caliscope/two_without_poses.toml": (
        {"cam_2": (300, 135), "cam_6": (300, 135), "cam_4": (240, 135), "cam_5": (240, 135)},
        ("cam_4", "cam_5"),
    ),
    "pose2sim/Calib.qca.txt": ({f"cam0{i}": (136, 240) for i in range(1, 5)}, ()),
}


def meeting(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per camera: how far in front of it the point nearest to all optical axes lies, and how far from its own axis."""
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    axes = poses[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    point = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centers))
    depth = np.einsum("ni,ni->n", axes, point - centers)
    return depth, np.linalg.norm(point - centers - depth[:, None] * axes, axis=1)


@pytest.mark.parametrize("file", FILES)
def test_a_real_export_is_a_rig_that_looks_at_one_place(file: str, tmp_path: Path) -> None:
    sizes, lost = FILES[file]
    for name, size in sizes.items():
        Image.new("RGB", size, (90, 90, 90)).save(tmp_path / f"{name}.png")
    shutil.copy(EXPORTS / file, tmp_path)
    with pytest.warns(RecordingWarning) as warned:
        rig = open_source(str(tmp_path)).info.train
    told = " ".join(str(one.message) for one in warned)
    assert ("without a pose" in told) == bool(lost)
    assert all(name in told for name in lost)
    assert set(rig.ids) == set(sizes) - set(lost)
    depth, off = meeting(np.asarray(rig.viewmats))
    assert (depth > 0).all()
    assert (off < 0.3 * depth).all()


def test_the_numbers_of_real_exports_are_those_of_the_files(tmp_path: Path) -> None:
    """Written down from the files: a Qualisys focal length in 1/64 pixel, and the centre of a camera in millimetres."""
    for i in range(1, 5):
        Image.new("RGB", (1088, 1920)).save(tmp_path / f"cam0{i}.png")
    text = (EXPORTS / "pose2sim/Calib.qca.txt").read_text()
    straight = re.sub(r'(radialDistortion\d|tangentalDistortion\d)="[^"]*"', r'\1="0"', text)
    (tmp_path / "Calib.qca.txt").write_text(straight)
    rig = open_source(str(tmp_path)).info.train
    assert rig.Ks[0] == pytest.approx(
        np.array(
            [
                [107599.671875 / 64, 0, 34110.316406 / 64 + 0.5],
                [0, 107588.828125 / 64, 60680.792969 / 64 + 0.5],
                [0, 0, 1],
            ]
        )
    )
    pose = np.asarray(rig.viewmats[0])
    assert pose[:3, :3] @ [1460.2323709212087, -1909.1590482454608, 1896.5058524092062] + pose[:3, 3] == pytest.approx(
        np.zeros(3), abs=1e-6
    )
    assert pose[1, 2] < -0.8, "the floor's z is up, and y of a camera is down"
