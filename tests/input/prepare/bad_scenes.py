"""Bad scenes: each is the good one with one fault. ``messages.json`` holds what ``scene validate`` says about each.

The page docs/reference/scene-checks.md is made from this table and those messages. To write the messages anew after a
deliberate change: ``python -m tests.input.prepare.bad_scenes [NAME ...]``, then read the difference.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.input.prepare.findings import Finding
from gsstream.input.prepare.validate import validate
from gsstream.input.recordings.open import open_source

MESSAGES = Path(__file__).parent / "messages.json"
#: cam00 to cam06 train, "test" tests; 240 x 180 pixels, 12 frames, two things move.
GOOD = "synthetic:width=240&height=180&views=7&frames=12&supersample=1&motion=4"
FRAMES = 12

Data = dict[str, Any]


@dataclass(frozen=True)
class BadScene:
    """``fault``: what is wrong, in words; ``code``: the check that finds it; ``spoil``: how the good one gets it."""

    name: str
    fault: str
    code: str
    spoil: Callable[[Path, Data], None]


def write_good(folder: Path) -> None:
    """The good scene as a folder."""
    source = open_source(GOOD)
    cameras = []
    for split in ("train", "test"):
        rig = source.info.train if split == "train" else source.info.test
        for i, name in enumerate(rig.ids):
            (folder / name).mkdir(parents=True)
            w2c, K = rig.viewmats[i].tolist(), rig.Ks[i].tolist()
            cameras.append(
                {
                    "id": name,
                    "split": split,
                    "width": rig.width,
                    "height": rig.height,
                    "K": K,
                    "w2c": w2c,
                    "frames": f"{name}/%06d.png",
                }
            )
        for t in range(FRAMES):
            for name, image in zip(rig.ids, source.frame(t, split).images, strict=True):
                save(folder / name / f"{t:06d}.png", image)
    data = {"schema": "opencv-multiview-1", "name": "good", "fps": 30, "frames": FRAMES, "cameras": cameras}
    (folder / "cameras.json").write_text(json.dumps(data))
    cloud = source.points("sparse")
    assert cloud is not None
    np.savez(folder / "points_frame0.npz", xyz=cloud.xyz, rgb=(cloud.rgb * 255).astype(np.uint8))


def spoiled(good: Path, folder: Path, bad: BadScene) -> Path:
    """A copy of the good scene with one fault."""
    shutil.copytree(good, folder)
    data = json.loads((folder / "cameras.json").read_text())
    bad.spoil(folder, data)
    if (folder / "cameras.json").exists():
        (folder / "cameras.json").write_text(json.dumps(data))
    return folder


def findings(folder: Path) -> list[Finding]:
    return validate(lambda scale: open_source(str(folder), scale))


def said(folder: Path, finding: Finding) -> str:
    return finding.message.replace(f"{folder.name}-prepared", "SCENE-prepared").replace(str(folder), "SCENE")


def without_numbers(message: str) -> str:
    """Measured numbers may differ in the last digit between machines."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", message)


def save(path: Path, image: Any) -> None:
    Image.fromarray(np.round(np.asarray(image) * 255).astype(np.uint8)).save(path, compress_level=1)


def load(path: Path) -> Any:
    return np.asarray(Image.open(path), np.float32) / 255


def camera(data: Data, name: str) -> Data:
    return next(c for c in data["cameras"] if c["id"] == name)


def pictures(folder: Path, name: str, change: Callable[[Any, int], Any]) -> None:
    """Change every picture of a camera."""
    for t in range(FRAMES):
        path = folder / name / f"{t:06d}.png"
        save(path, change(load(path), t))


def poses(data: Data, change: Callable[[Any], Any], only: str | None = None) -> None:
    for entry in data["cameras"]:
        if only in (None, entry["id"]):
            entry["w2c"] = change(np.array(entry["w2c"])).tolist()


def moved(pose: Any, factor: float) -> Any:
    out = pose.copy()
    out[:3, 3] *= factor
    return out


def early(folder: Path, name: str, frames: int) -> None:
    """A camera that started some frames early, from a longer recording: nothing repeats."""
    source = open_source(GOOD.replace("frames=12", "frames=20"))
    index = source.info.train.ids.index(name)
    for t in range(FRAMES):
        save(folder / name / f"{t:06d}.png", source.frame(t + frames).images[index])


def distorted(image: Any, _: int) -> Any:
    """Barrel distortion of a wide lens, k1 = -0.3, nearest neighbour."""
    height, width = image.shape[:2]
    focal = 0.95 * width
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    ux, uy = x, y
    for _step in range(8):  # the inverse of x (1 + k1 r^2)
        factor = 1 - 0.3 * (ux**2 + uy**2)
        ux, uy = x / factor, y / factor
    column = np.clip(np.floor(ux * focal + width / 2), 0, width - 1).astype(int)
    row = np.clip(np.floor(uy * focal + height / 2), 0, height - 1).astype(int)
    return image[row, column]


def swap(folder: Path, a: str, b: str) -> None:
    (folder / a).rename(folder / "aside")
    (folder / b).rename(folder / a)
    (folder / "aside").rename(folder / b)


def nan_pose(_: Path, data: Data) -> None:
    camera(data, "cam02")["w2c"][0][3] = float("nan")


def truncate(folder: Path, _: Data) -> None:
    path = folder / "cam03" / "000004.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resize(folder: Path, _: Data) -> None:
    for path in (folder / "cam03").iterdir():
        Image.open(path).resize((320, 240)).save(path)


def copy_camera(folder: Path, source: str, target: str) -> None:
    shutil.rmtree(folder / target)
    shutil.copytree(folder / source, folder / target)


def scale_K(data: Data, factor: float, only: str | None = None) -> None:
    for entry in data["cameras"]:
        if only in (None, entry["id"]):
            entry["K"] = (np.diag([factor, factor, 1]) @ np.array(entry["K"])).tolist()


def set_K(data: Data, name: str, row: int, column: int, value: float) -> None:
    camera(data, name)["K"][row][column] = value


def equal_poses(_: Path, data: Data) -> None:
    camera(data, "test")["w2c"] = camera(data, "cam03")["w2c"]


def turned(pose: Any) -> Any:
    """Looks the other way, from the same place."""
    return np.diag([-1.0, 1.0, -1.0, 1.0]) @ pose


def mirrored(pose: Any) -> Any:
    return np.diag([-1.0, 1.0, 1.0, 1.0]) @ pose


def sheared(pose: Any) -> Any:
    out = pose.copy()
    out[0, :3] += 0.1 * out[1, :3]
    return out


def nudged(pose: Any) -> Any:
    """Turned by three degrees about its vertical axis."""
    c, s = np.cos(np.radians(3)), np.sin(np.radians(3))
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]]) @ pose


def points_in_mm(folder: Path, _: Data) -> None:
    with np.load(folder / "points_frame0.npz") as arrays:
        xyz, rgb = arrays["xyz"], arrays["rgb"]
    np.savez(folder / "points_frame0.npz", xyz=xyz * 1000, rgb=rgb)


def rename_test(_: Path, data: Data) -> None:
    data["test_cameras"] = ["cam99"]


FLIP = np.diag([1.0, -1.0, -1.0, 1.0])

BAD = (
    BadScene("no-calibration", "cameras.json is missing", "calibration", lambda f, d: (f / "cameras.json").unlink()),
    BadScene("nan-pose", "a pose holds NaN", "calibration", nan_pose),
    BadScene("mirrored", "left-handed axes: one is mirrored", "calibration", lambda f, d: poses(d, mirrored)),
    BadScene("sheared", "a rotation that is none", "calibration", lambda f, d: poses(d, sheared, "cam02")),
    BadScene("repeated-id", "two cameras have one name", "calibration",
             lambda f, d: camera(d, "cam02").update(id="cam01")),
    BadScene("unknown-test", "a test camera that does not exist", "calibration", rename_test),
    BadScene("skew", "expected no skew", "calibration", lambda f, d: set_K(d, "cam01", 0, 1, 3.0)),
    BadScene("mixed-sizes", "cameras of two sizes", "calibration", lambda f, d: camera(d, "cam01").update(width=320)),
    BadScene("missing-image", "one image is missing", "files", lambda f, d: (f / "cam03/000004.png").unlink()),
    BadScene("frame-gap", "three frames were not exported", "files", lambda f, d: [
        (f / f"cam03/00000{t}.png").unlink() for t in (4, 5, 6)
    ]),
    BadScene("missing-camera", "a camera has no images", "files", lambda f, d: shutil.rmtree(f / "cam03")),
    BadScene("damaged-points", "points_frame0.npz is cut off", "files", lambda f, d: (
        (f / "points_frame0.npz").write_bytes((f / "points_frame0.npz").read_bytes()[:400])
    )),
    BadScene("other-resolution", "K of images of half the size", "intrinsics", lambda f, d: scale_K(d, 0.5)),
    BadScene("principal-point", "principal point outside of the image", "intrinsics",
             lambda f, d: set_K(d, "cam01", 0, 2, 900.0)),
    BadScene("focal-in-mm", "focal length in mm", "intrinsics", lambda f, d: (
        set_K(d, "cam01", 0, 0, 4.2), set_K(d, "cam01", 1, 1, 4.2)
    )),
    BadScene("one-in-mm", "one camera's translation in mm", "placement", lambda f, d: poses(
        d, lambda m: moved(m, 1000), "cam02"
    )),
    BadScene("points-in-mm", "points in mm, cameras in m", "placement", points_in_mm),
    BadScene("equal-poses", "the test camera has a training camera's pose", "placement", equal_poses),
    BadScene("opengl", "poses with OpenGL axes", "axes", lambda f, d: poses(d, lambda m: FLIP @ m)),
    BadScene("turned-away", "one camera looks the other way", "overlap", lambda f, d: poses(d, turned, "cam02")),
    BadScene("truncated-image", "half an image", "images", truncate),
    BadScene("wrong-size", "images of another size than declared", "calibration", resize),
    BadScene("black", "a black camera", "blank", lambda f, d: pictures(f, "cam03", lambda i, t: 0 * i)),
    BadScene("black-frame", "one black frame", "blank", lambda f, d: save(
        f / "cam03/000004.png", 0 * load(f / "cam03/000004.png")
    )),
    BadScene("grey", "a camera without colours among others", "colour", lambda f, d: pictures(
        f, "cam03", lambda i, t: i.mean(-1, keepdims=True).repeat(3, -1)
    )),
    BadScene("leaked-test", "the test camera shows a training camera's pictures", "same",
             lambda f, d: copy_camera(f, "cam03", "test")),
    BadScene("frozen", "a camera stands still", "frozen", lambda f, d: [
        shutil.copy(f / "cam03/000000.png", f / f"cam03/{t:06d}.png") for t in range(1, FRAMES)
    ]),
    BadScene("repeated-frame", "a camera repeats a frame", "repeated", lambda f, d: shutil.copy(
        f / "cam03/000004.png", f / "cam03/000005.png"
    )),
    BadScene("exposure", "a camera's exposure jumps", "brightness", lambda f, d: pictures(
        f, "cam03", lambda i, t: i * (1.0 if t < 6 else 0.7)
    )),
    BadScene("unsynchronised", "a camera's clock is off by two frames", "sync", lambda f, d: early(f, "cam03", 2)),
    BadScene("swapped", "two cameras' images are swapped", "sync", lambda f, d: swap(f, "cam01", "cam05")),
    BadScene("swapped-still", "the same, and nothing moves", "axes", lambda f, d: (
        swap(f, "cam01", "cam05"), d.update(frames=1)
    )),
    BadScene("camera-to-world", "c2w where w2c is expected", "axes", lambda f, d: poses(d, np.linalg.inv)),
    BadScene("distorted", "a lens with distortion, declared pinhole", "epipolar",
             lambda f, d: pictures(f, "cam03", distorted)),
    BadScene("nudged", "a camera was turned by 3 degrees after calibration", "epipolar",
             lambda f, d: poses(d, nudged, "cam03")),
)  # fmt: skip


def main() -> None:
    """Write the messages anew."""
    messages = json.loads(MESSAGES.read_text()) if MESSAGES.exists() and sys.argv[1:] else {}
    with tempfile.TemporaryDirectory() as name:
        good = Path(name) / "good"
        write_good(good)
        print("good:", findings(good))
        for bad in [b for b in BAD if not sys.argv[1:] or b.name in sys.argv[1:]]:
            folder = spoiled(good, Path(name) / bad.name, bad)
            found = findings(folder)
            ok = [f.code for f in found] == [bad.code]
            print("ok " if ok else "BAD", bad.name, [(f.code, f.severity, said(folder, f)) for f in found], flush=True)
            messages[bad.name] = [f.severity + ": " + said(folder, f) for f in found]
            shutil.rmtree(folder)
    ordered = {bad.name: messages[bad.name] for bad in BAD}
    MESSAGES.write_text(json.dumps(ordered, indent=1) + "\n")


if __name__ == "__main__":
    main()
