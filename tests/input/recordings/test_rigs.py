"""Calibrations as other programs write them: each written here by its published description, and read back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import SourceError
from gsstream.input.prepare.given import read_raw
from gsstream.input.recordings.detect import detect
from gsstream.input.recordings.open import open_source, read_layout
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.poses import from_rotation_vector, invert
from gsstream.input.recordings.transformed import transformed
from tests.input.recordings.tiny_recordings import write_video

WIDTH, HEIGHT = 96, 64
NAMES = ("cam_0", "cam_1", "cam_2")
#: k1, k2, p1, p2, k3 in OpenCV's order.
DISTORTION = (-0.08, 0.02, 0.001, -0.002, 0.003)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
FX, FY, CX, CY = 90.0, 91.0, 49.5, 31.0


def poses() -> list[Any]:
    """World to camera, OpenCV axes."""
    out = []
    for turn, place in (
        ((0.1, 0.2, -0.3), (0.5, 0.1, 3)),
        ((0.2, -0.4, 0.1), (-1, 0.3, 2.5)),
        ((0.0, 0.6, 0.2), (0, 1, 4)),
    ):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = from_rotation_vector(np.array(turn)), place
        out.append(pose)
    return out


def qualisys(folder: Path) -> None:
    cameras = ""
    for name, pose in zip(NAMES, poses(), strict=True):
        given = FLIP @ pose
        center = -given[:3, :3].T @ given[:3, 3]
        turn = " ".join(f'r{i + 1}{j + 1}="{float(given[i, j])!r}"' for i in range(3) for j in range(3))
        where = " ".join(f'{axis}="{float(value)!r}"' for axis, value in zip("xyz", center, strict=True))
        k1, k2, p1, p2, k3 = DISTORTION
        cameras += (
            f'<camera active="1" serial="{name}" viewrotation="0"><fov_video left="2" top="0" right="{WIDTH + 1}" '
            f'bottom="{HEIGHT - 1}"/><transform {turn} {where}/><intrinsic '
            f'focalLengthU="{64 * FX}" focalLengthV="{64 * FY}" centerPointU="{64 * (CX - 0.5 + 2)}" '
            f'centerPointV="{64 * (CY - 0.5)}" radialDistortion1="{k1}" radialDistortion2="{k2}" '
            f'radialDistortion3="{k3}" tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    (folder / "Calib.qca.txt").write_text(
        f"<?xml version='1.0'?><calibration><cameras>{cameras}</cameras></calibration>"
    )


def toml(folder: Path, vector: bool) -> None:
    """Anipose and Pose2Sim (names, rotation vectors), or Caliscope (numbers, matrices)."""
    lines = ["[metadata]", "adjusted = false"]
    for number, pose in enumerate(poses()):
        matrix = [[FX, 0.0, CX - 0.5], [0.0, FY, CY - 0.5], [0.0, 0.0, 1.0]]
        rotation = rotation_vector(pose[:3, :3]) if vector else pose[:3, :3].tolist()
        lines += [
            f"[cam_{number}]" if vector else f"[cameras.{number}]",
            f'name = "cam_{number}"' if vector else f"cam_id = {number}",
            f"size = [{WIDTH}, {HEIGHT}]",
            f"matrix = {matrix}",
            f"distortions = {list(DISTORTION)}",
            f"rotation = {rotation}",
            f"translation = {pose[:3, 3].tolist()}",
        ]
    (folder / "calibration").mkdir()
    (folder / "calibration" / "rig.toml").write_text("\n".join(lines) + "\n")


def rotation_vector(R: Any) -> list[float]:
    angle = np.arccos((np.trace(R) - 1) / 2)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (2 * np.sin(angle))
    return (angle * axis).tolist()


def opencv(folder: Path) -> None:
    def matrix(name: str, values: Any) -> str:
        values = np.atleast_2d(np.asarray(values, float))
        rows, columns = values.shape
        data = ", ".join(map(repr, values.ravel().tolist()))
        return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"

    for name, pose in zip(NAMES, poses(), strict=True):
        K = [[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]]
        text = f"%YAML:1.0\n---\nimage_width: {WIDTH}\nimage_height: {HEIGHT}\n" + matrix("camera_matrix", K)
        text += matrix("distortion_coefficients", DISTORTION) + matrix("R", pose[:3, :3]) + matrix("T", pose[:3, 3:])
        (folder / f"{name}.yml").write_text(text)


def metashape(folder: Path) -> None:
    k1, k2, p1, p2, k3 = DISTORTION
    values = {
        "f": FY,
        "cx": CX - WIDTH / 2,
        "cy": CY - HEIGHT / 2,
        "b1": FX - FY,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": p2,
        "p2": p1,
    }
    optics = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" label="{name}.png"><transform>'
        f"{' '.join(map(repr, invert(pose).ravel().tolist()))}</transform></camera>"
        for i, (name, pose) in enumerate(zip(NAMES, poses(), strict=True))
    )
    (folder / "cameras.xml").write_text(
        f'<?xml version="1.0"?><document version="1.5.0"><chunk><sensors><sensor id="0" label="unknown" type="frame">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/><calibration class="initial"><f>1</f></calibration>'
        f'<calibration type="frame" class="adjusted">{optics}</calibration></sensor></sensors>'
        f"<cameras>{cameras}<camera id='9' sensor_id='0' label='unplaced'/></cameras></chunk></document>"
    )


def reality_xmp(folder: Path) -> None:
    k1, k2, p1, p2, k3 = DISTORTION
    for name, pose in zip(NAMES, poses(), strict=True):
        turn = " ".join(map(repr, pose[:3, :3].ravel().tolist()))
        center = " ".join(map(repr, (-pose[:3, :3].T @ pose[:3, 3]).tolist()))
        (folder / f"{name}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
            f'xcr:DistortionModel="brown3t2" xcr:DistortionCoeficients="{k1} {k2} {k3} 0 {p1} {p2}" '
            f'xcr:FocalLength35mm="{36 * FX / WIDTH!r}" xcr:PrincipalPointU="{(CX - WIDTH / 2) / WIDTH!r}" '
            f'xcr:PrincipalPointV="{(CY - HEIGHT / 2) / WIDTH!r}"><xcr:Rotation>{turn}</xcr:Rotation>'
            f"<xcr:Position>{center}</xcr:Position></rdf:Description></rdf:RDF></x:xmpmeta>"
        )


def reality_csv(folder: Path) -> None:
    k1, k2, p1, p2, k3 = DISTORTION
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, pose in zip(NAMES, poses(), strict=True):
        c2w = invert(pose) @ FLIP  # OpenGL axes; turned about z by -heading, then x by pitch, then y by roll
        R = c2w[:3, :3]
        pitch, roll, heading = np.arcsin(R[2, 1]), np.arctan2(-R[2, 0], R[2, 2]), -np.arctan2(-R[0, 1], R[1, 1])
        angles = np.degrees([heading, pitch, roll]).tolist()
        optics = [36 * FX / WIDTH, 36 * (CX - WIDTH / 2) / WIDTH, 36 * (CY - HEIGHT / 2) / WIDTH]
        rows.append(
            ",".join([f"{name}.png", *map(repr, [*c2w[:3, 3].tolist(), *angles, *optics, k1, k2, k3, 0, p1, p2])])
        )
    (folder / "export.csv").write_text("\n".join(rows) + "\n")


#: Name -> (writer, whether the format knows one focal length only).
FORMATS: dict[str, tuple[Callable[[Path], None], bool]] = {
    "qualisys": (qualisys, False),
    "anipose": (lambda f: toml(f, True), False),
    "caliscope": (lambda f: toml(f, False), False),
    "opencv": (opencv, False),
    "metashape": (metashape, False),
    "realitycapture-xmp": (reality_xmp, True),
    "realitycapture-csv": (reality_csv, True),
}


def pictures(folder: Path) -> None:
    folder.mkdir()
    for i, name in enumerate(NAMES):
        values = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        Image.fromarray(values).save(folder / f"{name}.png")


@pytest.mark.parametrize("name", FORMATS)
def test_a_calibration_is_read_as_it_was_written(tmp_path: Path, name: str) -> None:
    write, one_focal = FORMATS[name]
    pictures(folder := tmp_path / "rig")
    write(folder)
    assert detect(folder) == "calibrated"
    recording = read_layout("calibrated", folder)
    assert recording.rig.ids == NAMES
    assert np.allclose(recording.rig.viewmats, poses(), atol=1e-9)
    K = [[FX, 0, CX], [0, FX if one_focal else FY, CY], [0, 0, 1]]
    assert np.allclose(recording.rig.Ks, K, atol=1e-9)
    k1, k2, p1, p2, k3 = DISTORTION
    for lens in recording.lenses.values():
        assert lens.kind == "radial"
        assert np.allclose((*lens.k[:3], *lens.p), (k1, k2, k3, p1, p2))
    assert len(recording.lenses) == 3
    assert open_source(str(folder)).frame(0).images.shape == (3, HEIGHT, WIDTH, 3), "a run takes it, too"


def spoil(text: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for path in folder.rglob("*.*"):
            if path.suffix != ".png":
                path.write_text(path.read_text().replace(text, new))

    return change


@pytest.mark.parametrize(
    ("name", "fault", "message"),
    [
        ("anipose", spoil("rotation", "turn"), "calibrate the rig, too: only their lenses are known.*0 of 3 stay"),
        ("anipose", spoil(f"size = [{WIDTH}, {HEIGHT}]", "size = [96, 96]"), "another part of the view"),
        ("anipose", spoil('name = "cam_', 'name = "left2'), "do not fit the pictures"),
        ("opencv", spoil("image_width", "width"), "expected image_width and image_height"),
        ("opencv", spoil("T: ", "nframes: "), "calibrate the rig, too"),
        ("qualisys", spoil('viewrotation="0"', 'viewrotation="90"'), "export it unturned"),
        (
            "metashape",
            spoil('type="frame">', 'type="spherical">'),
            r"^[^:]*cameras\.xml: sensor 'unknown': expected type",
        ),
        ("realitycapture-xmp", spoil("brown3t2", "division"), "a model of Brown"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_told_with_the_cure(
    tmp_path: Path, name: str, fault: Callable[[Path], None], message: str
) -> None:
    pictures(folder := tmp_path / "rig")
    FORMATS[name][0](folder)
    fault(folder)
    with pytest.raises(SourceError, match=message):
        read_layout("calibrated", folder)


def test_pictures_that_lost_a_border_or_were_scaled_keep_their_rays(tmp_path: Path) -> None:
    pictures(folder := tmp_path / "rig")
    toml(folder, True)
    for size, expected in (((WIDTH - 2, HEIGHT), (FX, CX)), ((WIDTH // 2, HEIGHT // 2), (FX / 2, CX / 2))):
        for name in NAMES:
            Image.new("RGB", size).save(folder / f"{name}.png")
        K = read_layout("calibrated", folder).rig.Ks[0]
        assert np.allclose((K[0, 0], K[0, 2]), expected)


def test_two_calibrations_in_one_folder_are_named(tmp_path: Path) -> None:
    pictures(folder := tmp_path / "rig")
    opencv(folder)
    qualisys(folder)
    with pytest.raises(SourceError, match=r"several calibrations: .*Calib\.qca\.txt, .*cam_0\.yml"):
        read_layout("calibrated", folder)


def declared(folder: Path, count: int | None = None, **more: Any) -> None:
    """cameras.json beside videos, as a program of one's own writes it: of two frames, the first those of pictures()."""
    K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
    cameras = []
    for i, (name, pose) in enumerate(zip(NAMES, poses(), strict=True)):
        first = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        write_video(folder / f"{name}.mkv", np.stack([first, first[::-1]]))
        entry = {"id": name, "width": WIDTH, "height": HEIGHT, "K": K, "w2c": pose.tolist(), "frames": f"{name}.mkv"}
        cameras.append(entry | {"distortion": list(DISTORTION)} | more)
    data = {"cameras": cameras} if count is None else {"frames": count, "cameras": cameras}
    (folder / "cameras.json").write_text(json.dumps(data))


def test_cameras_json_takes_videos_and_lenses_without_naming_its_schema(tmp_path: Path) -> None:
    """Against the same rig as Anipose writes it, with the pictures as files."""
    pytest.importorskip("av")
    pictures(reference := tmp_path / "rig")
    toml(reference, True)
    declared(folder := tmp_path / "own")
    np.savez(folder / "points_frame0.npz", xyz=np.zeros((2, 3)), rgb=np.zeros((2, 3), np.uint8))
    source, expected = open_source(str(folder)), open_source(str(reference))
    assert source.info.num_frames == 2
    assert np.allclose(source.info.train.Ks, expected.info.train.Ks, atol=1e-9)
    assert np.abs(source.frame(0).images - expected.frame(0).images).max() < 1e-6
    assert np.abs(source.frame(1).images - expected.frame(0).images).max() > 0.1
    held = transformed(source, DataOptions(test_cameras=(NAMES[0],)))
    assert (len(source.points() or ()), held.points()) == (2, None), "nobody says that it took no part in them"
    raw, known = read_raw(str(folder)), read_raw(str(reference)).known
    assert raw.known is not None
    assert known is not None
    for got, wanted in zip(raw.known.lenses, known.lenses, strict=True):
        assert got.kind == wanted.kind
        assert np.allclose((*got.k[:3], *got.p), (*wanted.k[:3], *wanted.p))
    assert np.allclose(raw.known.Ks, known.Ks)
    assert [len(list(camera.frames(None))) for camera in raw.cameras] == [2, 2, 2]
    declared(folder, 1)
    assert open_source(str(folder)).info.num_frames == 1


@pytest.mark.parametrize(
    ("count", "more", "message"),
    [
        (3, {}, r"cam_0\.mkv: 3 frames are declared, the video holds 2"),
        (2, {"distortion": [0.1]}, "expected 0, 4, 5, 8 or 12 coefficients"),
        (2, {"fisheye": True}, "expected 4 coefficients of a fisheye"),
        (2, {"distortion": "none"}, "must be a list of numbers"),
        (2, {"frames": "no.mp4"}, "camera 'cam_0' has no video"),
        (2, {"width": WIDTH + 1}, rf"pictures of camera 'cam_0' are {WIDTH} x {HEIGHT} pixels"),
    ],
)
def test_videos_and_lenses_that_do_not_fit_are_named(
    tmp_path: Path, count: int, more: dict[str, Any], message: str
) -> None:
    pytest.importorskip("av")
    declared(tmp_path, count, **more)
    with pytest.raises(SourceError, match=message):
        open_source(str(tmp_path))


def test_a_growing_recording_takes_neither(tmp_path: Path) -> None:
    pytest.importorskip("av")
    declared(tmp_path)
    with pytest.raises(SourceError, match="names a single video; a growing recording needs a pattern"):
        open_source(f"watch:{tmp_path}")
    text = (tmp_path / "cameras.json").read_text().replace(".mkv", "/%d.png")
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(SourceError, match="has 'distortion'; a growing recording needs pictures of a pinhole"):
        open_source(f"watch:{tmp_path}")
