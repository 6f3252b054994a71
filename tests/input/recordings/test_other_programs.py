"""What programs write that has no description of its own: by real files, and by what their public writers put down."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_rigs import FORMATS, NAMES, pictures, poses

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source, read_layout
from gsstream.input.recordings.rigs import metashape
from gsstream.input.recordings.sync import RecordingWarning

EXPORT = Path(__file__).parent / "exports" / "geograypher" / "camera.xml"


def test_a_lens_of_metashape_bends_as_its_manual_says() -> None:
    """A real calibration, with k4 and skew; the manual's formulas, appendix D, for points of the camera."""
    (camera,) = metashape.read(EXPORT, EXPORT.read_text())
    assert camera.name == "000001-01_00001"
    assert camera.size == (5280, 3956)
    X, Y, Z = np.random.default_rng(0).uniform((-0.7, -0.5, 1), (0.7, 0.5, 1.2), (1000, 3)).T
    x, y = X / Z, Y / Z
    f, cx, cy, b1, b2 = 3705.4728792737214, 11.6738523909, -27.7497969199, 0.5262024073, -0.3058334293
    k1, k2, k3, k4 = -0.0919367147, -0.0762807468, 0.1162639394, -0.0761413904
    p1, p2 = -0.0003134847, 0.0001164035
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    bent_x = x * radial + (p1 * (r2 + 2 * x**2) + 2 * p2 * x * y)
    bent_y = y * radial + (p2 * (r2 + 2 * y**2) + 2 * p1 * x * y)
    u = 5280 * 0.5 + cx + bent_x * f + bent_x * b1 + bent_y * b2
    v = 3956 * 0.5 + cy + bent_y * f
    got_x, got_y = camera.lens.distort(x, y)
    assert camera.K[0, 0] * got_x + camera.K[0, 2] == pytest.approx(u, abs=1e-8)
    assert camera.K[1, 1] * got_y + camera.K[1, 2] == pytest.approx(v, abs=1e-8)
    assert camera.w2c is not None
    # The camera's centre, last column of the transform, is the origin of its own coordinates.
    assert camera.w2c @ [7.04224697, 7.05403071, 0.43561421, 1] == pytest.approx([0, 0, 0, 1], abs=1e-6)


def metashape_rig(folder: Path, pattern: str, new: str) -> Path:
    pictures(folder)
    FORMATS["metashape"][0](folder)
    path = folder / "cameras.xml"
    text, done = re.subn(pattern, new, path.read_text())
    assert done
    path.write_text(text)
    return folder


def test_components_of_metashape_are_not_mixed(tmp_path: Path) -> None:
    """Their coordinates have nothing in common."""
    folder = metashape_rig(tmp_path / "a", 'label="cam_([01])', r'component_id="0" label="cam_\1')
    text = (folder / "cameras.xml").read_text().replace('label="cam_2', 'component_id="4" label="cam_2')
    (folder / "cameras.xml").write_text(text)
    with pytest.warns(RecordingWarning, match=r"of other components are left out: cam_2\.png; 3 of 4 stay"):
        assert open_source(str(folder)).info.train.ids == NAMES[:2]


def test_cameras_that_metashape_has_disabled_do_not_count(tmp_path: Path) -> None:
    folder = metashape_rig(tmp_path / "a", 'label="cam_2', 'enabled="false" label="cam_2')
    with pytest.warns(RecordingWarning, match=r"without a calibration are left out: cam_2; 2 of 3 stay"):
        assert open_source(str(folder)).info.train.ids == NAMES[:2]


def test_labels_of_metashape_may_be_paths_of_windows(tmp_path: Path) -> None:
    folder = metashape_rig(tmp_path / "a", 'label="cam_', r'label="C:\\\\rig\\\\cam_')
    assert open_source(str(folder)).info.train.ids == NAMES


@pytest.mark.parametrize("k4", [0.0, -0.05])
def test_a_table_of_realitycapture_may_begin_with_a_count_and_lack_columns(tmp_path: Path, k4: float) -> None:
    pictures(folder := tmp_path / "a")
    FORMATS["realitycapture-csv"][0](folder)
    path = folder / "export.csv"
    plain = read_layout("calibrated", folder)
    path.write_text(f"#cameras 3\n{path.read_text()}".replace(",0,", f",{k4},"))
    counted = read_layout("calibrated", folder)
    assert np.array_equal(counted.rig.viewmats, plain.rig.viewmats)
    assert {lens.eighth for lens in counted.lenses.values()} == {k4}
    head, *rows = path.read_text().splitlines()[1:]
    assert head.endswith("k1,k2,k3,k4,t1,t2")
    less = [row.rsplit(",", 4)[0] + "," + ",".join(row.rsplit(",", 2)[1:]) for row in rows]
    path.write_text("\n".join([head.replace("k3,k4,", ""), *less]) + "\n")
    with pytest.warns(RecordingWarning, match="columns that the table does not have count as zero: k3, k4"):
        short = read_layout("calibrated", folder)
    for name, lens in short.lenses.items():
        assert (lens.k[:2], lens.k[2], lens.eighth) == (plain.lenses[name].k[:2], 0.0, 0.0)
        assert lens.p == plain.lenses[name].p
    path.write_text(path.read_text().replace(",f,", ",focal,"))
    with pytest.raises(SourceError, match=r"export\.csv: not cameras of RealityCapture: there is no 'f'"):
        read_layout("calibrated", folder)


def test_sidecars_of_realitycapture_without_a_pose_steer_an_alignment(tmp_path: Path) -> None:
    """As the program reads them: a group and an initial focal length, and nothing of where the camera stands."""
    pictures(folder := tmp_path / "a")
    FORMATS["realitycapture-xmp"][0](folder)
    (folder / "cam_2.xmp").write_text(
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xcr:Version="4" xcr:CalibrationPrior="initial" xcr:CalibrationGroup="7" xcr:Skew="0" '
        'xcr:DistortionGroup="7" xcr:DistortionModel="brown3" xcr:FocalLength35mm="29" '
        'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"></rdf:Description></rdf:RDF></x:xmpmeta>'
    )
    with pytest.warns(RecordingWarning, match=r"without a pose .*cam_2; 2 of 3 stay"):
        assert open_source(str(folder)).info.train.ids == NAMES[:2]


def entries(**each: Any) -> list[dict[str, Any]]:
    """Of nerfstudio's converters: ./images/frame_00001.png, camera to world with OpenGL axes."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    made = []
    for i, pose in enumerate(poses()):
        matrix = (np.linalg.inv(pose) @ flip).tolist()
        made.append({**each, "file_path": f"./images/frame_{i + 1:05d}.png", "transform_matrix": matrix})
    return made


SIZE = {"w": 96, "h": 64}
OPTICS = {"fl_x": 90.0, "fl_y": 91.0, "cx": 49.5, "cy": 31.0}
#: Program -> what nerfstudio's converter for it writes (nerfstudio 1.0 and later).
CONVERTED: dict[str, dict[str, Any]] = {
    "Polycam": {"camera_model": "OPENCV", "orientation_override": "none", "frames": entries(**OPTICS, **SIZE)},
    "Record3D": {**OPTICS, **SIZE, "camera_model": "OPENCV", "frames": entries()},
    "Metashape": {
        **OPTICS,
        **SIZE,
        "k1": 0.0,
        "k2": 0.0,
        "k3": 0.0,
        "k4": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "camera_model": "OPENCV",
        "frames": entries(),
        "applied_transform": [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]],
    },
    "RealityCapture": {
        "camera_model": "OPENCV",
        "orientation_override": "none",
        **SIZE,
        "frames": entries(**OPTICS, **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), "0")),
    },
}


@pytest.mark.parametrize("program", CONVERTED)
@pytest.mark.filterwarnings("error")
def test_what_nerfstudio_makes_of_other_programs_is_read(program: str, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(len(NAMES)):
        Image.new("RGB", (96, 64), (i, i, i)).save(tmp_path / f"images/frame_{i + 1:05d}.png")
    (tmp_path / "transforms.json").write_text(json.dumps(CONVERTED[program], indent=4))
    rig = open_source(str(tmp_path)).info.train
    assert np.allclose(rig.viewmats, poses(), atol=1e-9)
    assert np.allclose(rig.Ks, [[90, 0, 49.5], [0, 91, 31], [0, 0, 1]])
