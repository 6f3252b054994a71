"""Tiny recordings in the exact on-disk layouts, written from one known scene, and each layout's own way to project.

``World`` is the truth. Every writer stores it in its layout's convention with formulas of its own; every ``project_*``
reads the stored numbers back with the layout's documentation in hand, and nothing of gsstream, and says on which pixel
(origin at the image corner) a 3-D point falls. The readers must agree.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.input.recordings.synthetic import SyntheticSource

SIZE = (48, 32)
FRAMES = 3
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class World:
    """Cameras (world to camera, OpenCV axes; K with corner origin), uint8 pictures [T, C, H, W, 3], surface points."""

    poses: Array
    Ks: Array
    pictures: Array
    xyz: Array
    rgb: Array


def make_world(views: int = 4, frames: int = FRAMES, size: tuple[int, int] = SIZE) -> World:
    """The analytic scene; its test camera comes first, with square pixels and the principal point in the middle."""
    query = f"frames={frames}&views={views - 1}&width={size[0]}&height={size[1]}&supersample=1&motion=3"
    source = SyntheticSource.from_query(query)
    test, train = source.info.test, source.info.train
    shots = [np.concatenate([source.frame(t, "test").images, source.frame(t).images]) for t in range(frames)]
    cloud = source.points("sparse")
    return World(
        poses=np.concatenate([test.viewmats, train.viewmats]),
        Ks=np.concatenate([test.Ks, train.Ks]),
        pictures=np.round(np.stack(shots) * 255).astype(np.uint8),
        xyz=cloud.xyz[:300].astype(np.float64),
        rgb=np.round(cloud.rgb[:300] * 255).astype(np.uint8),
    )


def world_points(world: World) -> Array:
    """[P, 3] points in front of all cameras, near what they look at."""
    return np.random.default_rng(0).normal(world.xyz.mean(0), 0.15, (20, 3))


def write_video(path: Path, pictures: Array, *, rate: int = 30, codec: str = "libx264rgb", **options: Any) -> None:
    """Lossless by default."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "rgb24" if codec == "libx264rgb" else "yuv420p"
        stream.options = {"qp": "0", "bf": "2", "g": "4", **{k: str(v) for k, v in options.items()}}
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def write_png(path: Path, picture: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)


def write_frames(folder: Path, pictures: Array, *, digits: int = 4, first: int = 0, suffix: str = "png") -> None:
    for t, picture in enumerate(pictures):
        write_png(folder / f"{t + first:0{digits}d}.{suffix}", picture)


def write_ply(path: Path, xyz: Array, rgb: Array) -> None:
    floats, bytes_ = [(axis, "<f4") for axis in "xyz"], [(c, "u1") for c in ("red", "green", "blue")]
    rows = np.zeros(len(xyz), floats + bytes_)
    for i, axis in enumerate("xyz"):
        rows[axis] = xyz[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        rows[channel] = rgb[:, i]
    names = [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *names, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


# N3DV and Meet Room: LLFF ------------------------------------------------------------------------------------


def poses_bounds(world: World) -> Array:
    rows = []
    for pose, K in zip(world.poses, world.Ks, strict=True):
        rotation, center = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
        right, down, forward = rotation
        height_width_focal = np.array([SIZE[1], SIZE[0], K[0, 0]], np.float64)
        matrix = np.stack([down, right, -forward, center, height_width_focal], axis=1)
        rows.append(np.concatenate([matrix.ravel(), [0.5, 8.0]]))
    return np.stack(rows)


def write_n3dv(folder: Path, world: World, *, style: str = "videos") -> Path:
    folder.mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", poses_bounds(world))
    for c in range(len(world.poses)):
        shots = world.pictures[:, c]
        if style == "videos":
            write_video(folder / f"cam{c:02d}.mp4", shots)
        elif style == "images":
            write_frames(folder / f"cam{c:02d}" / "images", shots)
        elif style == "folders":
            write_frames(folder / f"cam{c:02d}", shots)
        else:
            for t, picture in enumerate(shots):
                write_png(folder / f"frame{t + 1:06d}" / f"cam{c:02d}.png", picture)
    return folder


def write_meetroom(folder: Path, world: World) -> Path:
    folder.mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", poses_bounds(world))
    for c in range(len(world.poses)):
        write_video(folder / f"cam_{c}.mp4", world.pictures[:, c])
    return folder


def project_llff(folder: Path, camera: int, points: Array) -> Array:
    matrix = np.load(folder / "poses_bounds.npy")[camera, :15].reshape(3, 5)
    down, right, back, center, (height, width, focal) = matrix.T
    offset = points - center
    depth = -(offset @ back)
    return np.stack([focal * (offset @ right) / depth + width / 2, focal * (offset @ down) / depth + height / 2], 1)


# ENeRF-Outdoor: EasyMocap ------------------------------------------------------------------------------------


def _opencv(name: str, matrix: Array) -> str:
    rows, columns = matrix.shape
    data = ", ".join(repr(float(v)) for v in matrix.ravel())
    return f"{name}: !!opencv-matrix\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: [{data}]\n"


def write_enerf(folder: Path, world: World, *, distortion: Array | None = None) -> Path:
    names = [f"{c:02d}" for c in range(len(world.poses))]
    head = "%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{name}"\n' for name in names)
    intri, extri = head, head
    for c, name in enumerate(names):
        K = world.Ks[c].copy()
        K[:2, 2] -= 0.5  # OpenCV: (0, 0) is the centre of the first pixel
        intri += _opencv(f"K_{name}", K)
        intri += _opencv(f"dist_{name}", np.zeros((5, 1)) if distortion is None else distortion.reshape(5, 1))
        extri += _opencv(f"R_{name}", _rotation_vector(world.poses[c, :3, :3]).reshape(3, 1))
        extri += _opencv(f"Rot_{name}", world.poses[c, :3, :3])
        extri += _opencv(f"T_{name}", world.poses[c, :3, 3:])
        write_frames(folder / "images" / name, world.pictures[:, c], digits=6)
    (folder / "intri.yml").write_text(intri)
    (folder / "extri.yml").write_text(extri)
    return folder


def _rotation_vector(rotation: Array) -> Array:
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return axis * angle / (2 * np.sin(angle))


def _read_opencv(path: Path, name: str) -> Array:
    lines = path.read_text().split("\n")
    at = lines.index(f"{name}: !!opencv-matrix")
    rows, columns = (int(lines[at + k].split(":")[1]) for k in (1, 2))
    return np.array(json.loads(lines[at + 4].split(":")[1])).reshape(rows, columns)


def project_enerf(folder: Path, camera: int, points: Array) -> Array:
    name = f"{camera:02d}"
    K = _read_opencv(folder / "intri.yml", f"K_{name}")
    vector = _read_opencv(folder / "extri.yml", f"R_{name}").ravel()
    angle = np.linalg.norm(vector)
    axis = vector / angle
    # Rodrigues' formula for vectors.
    turned = (
        points * np.cos(angle)
        + np.cross(axis, points) * np.sin(angle)
        + np.outer(points @ axis, axis) * (1 - np.cos(angle))
    )
    x, y, z = (turned + _read_opencv(folder / "extri.yml", f"T_{name}").ravel()).T
    pixel_index = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], 1)
    return pixel_index + 0.5


# CMU Panoptic: Dynamic 3D Gaussians --------------------------------------------------------------------------


def write_panoptic(folder: Path, world: World) -> Path:
    times, cameras = world.pictures.shape[:2]
    for name, chosen in (("test", [0]), ("train", list(range(1, cameras)))):
        meta = {
            "w": SIZE[0],
            "h": SIZE[1],
            "k": [[world.Ks[c].tolist() for c in chosen]] * times,
            "w2c": [[world.poses[c].tolist() for c in chosen]] * times,
            "fn": [[f"{c}/{t:06d}.png" for c in chosen] for t in range(times)],
            "cam_id": [chosen] * times,
        }
        for c in chosen:
            write_frames(folder / "ims" / str(c), world.pictures[:, c], digits=6)
        (folder / f"{name}_meta.json").write_text(json.dumps(meta))
    cloud = np.concatenate([world.xyz, world.rgb / 255, np.ones((len(world.xyz), 1))], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=cloud)
    return folder


def project_panoptic(folder: Path, camera: int, points: Array) -> Array:
    meta = json.loads((folder / f"{'train' if camera else 'test'}_meta.json").read_text())
    c = meta["cam_id"][0].index(camera)
    inside = np.linalg.inv(np.linalg.inv(np.array(meta["w2c"][0][c]))) @ np.concatenate([points, np.ones((20, 1))], 1).T
    pixels = np.array(meta["k"][0][c]) @ inside[:3]
    return (pixels[:2] / pixels[2]).T


# COLMAP ------------------------------------------------------------------------------------------------------


def quaternion(rotation: Array) -> Array:
    """wxyz, by the eigenvector of Bar-Itzhack's matrix: nothing in common with how it is read."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    K = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K / 3)[1][:, -1]
    return np.array([w, x, y, z]) * (1 if w > 0 else -1)


def tracks(world: World) -> list[list[int]]:
    """Which images see a point: the test image (0) sees every third."""
    cameras = len(world.poses)
    return [
        sorted({1 + p % (cameras - 1), 1 + (p + 1) % (cameras - 1)} | ({0} if p % 3 == 0 else set()))
        for p in range(len(world.xyz))
    ]


def observations(world: World) -> list[list[int]]:
    """Per image, the points it sees; their place in this list is what a track refers to."""
    return [[p for p, track in enumerate(tracks(world)) if c in track] for c in range(len(world.poses))]


def _track(p: int, track: list[int], seen: list[list[int]]) -> list[tuple[int, int]]:
    return [(c + 1, seen[c].index(p)) for c in track]


def write_colmap(
    folder: Path,
    world: World,
    *,
    binary: bool = True,
    frames: str = "videos",
    model: str = "PINHOLE",
    extra: tuple[float, ...] = (),
) -> Path:
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    names = [f"cam{c:02d}.png" for c in range(len(world.poses))]
    params = [(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *extra) for K in world.Ks]
    (_write_colmap_binary if binary else _write_colmap_text)(sparse, world, names, params, model)
    for c, name in enumerate(names):
        if frames == "videos":
            write_video(folder / "videos" / f"{Path(name).stem}.mp4", world.pictures[:, c])
        elif frames == "folders":
            write_frames(folder / "images" / Path(name).stem, world.pictures[:, c])
        else:
            write_png(folder / "images" / name, world.pictures[0, c])
    return folder


_NUMBERS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def _write_colmap_binary(sparse: Path, world: World, names: list[str], params: list[Any], model: str) -> None:
    seen = observations(world)
    with (sparse / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for c, values in enumerate(params):
            file.write(struct.pack("<iiQQ", c + 1, _NUMBERS[model], *SIZE) + struct.pack(f"<{len(values)}d", *values))
    with (sparse / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for c, name in enumerate(names):
            file.write(struct.pack("<i", c + 1))
            file.write(struct.pack("<7d", *quaternion(world.poses[c, :3, :3]), *world.poses[c, :3, 3]))
            file.write(struct.pack("<i", c + 1) + name.encode() + b"\0")
            file.write(struct.pack("<Q", len(seen[c]) + 1))
            file.write(b"".join(struct.pack("<ddq", 1.5, 2.5, p) for p in [*(q + 1 for q in seen[c]), -1]))
    with (sparse / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(world.xyz)))
        for p, track in enumerate(tracks(world)):
            file.write(struct.pack("<Q3d3Bd", p + 1, *world.xyz[p], *world.rgb[p].tolist(), 0.5))
            file.write(struct.pack("<Q", len(track)))
            file.write(b"".join(struct.pack("<ii", *pair) for pair in _track(p, track, seen)))


def _write_colmap_text(sparse: Path, world: World, names: list[str], params: list[Any], model: str) -> None:
    seen = observations(world)
    text = "# Camera list\n"
    for c, values in enumerate(params):
        text += f"{c + 1} {model} {SIZE[0]} {SIZE[1]} {' '.join(repr(float(v)) for v in values)}\n"
    (sparse / "cameras.txt").write_text(text)
    text = "# Image list with two lines of data per image:\n# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
    for c, name in enumerate(names):
        pose = [*quaternion(world.poses[c, :3, :3]), *world.poses[c, :3, 3]]
        text += f"{c + 1} {' '.join(repr(float(v)) for v in pose)} {c + 1} {name}\n"
        text += " ".join(f"1.5 2.5 {p + 1}" for p in seen[c]) + "\n"
    (sparse / "images.txt").write_text(text)
    text = "# 3D point list\n"
    for p, track in enumerate(tracks(world)):
        place = " ".join(repr(float(v)) for v in world.xyz[p])
        text += f"{p + 1} {place} {' '.join(map(str, world.rgb[p]))} 0.5 "
        text += " ".join(f"{image} {at}" for image, at in _track(p, track, seen)) + "\n"
    (sparse / "points3D.txt").write_text(text)


def project_colmap(folder: Path, camera: int, points: Array) -> Array:
    """From the text files; rotates by quaternion products."""
    row = (folder / "sparse/0/images.txt").read_text().split("\n")[2 + 2 * camera].split()
    w, vector, shift = float(row[1]), np.array(row[2:5], float), np.array(row[5:8], float)
    x, y, z = (points + 2 * np.cross(vector, np.cross(vector, points) + w * points) + shift).T
    fx, fy, cx, cy = map(float, (folder / "sparse/0/cameras.txt").read_text().split("\n")[1 + camera].split()[4:8])
    return np.stack([fx * x / z + cx, fy * y / z + cy], 1)


# nerfstudio --------------------------------------------------------------------------------------------------


def write_nerfstudio(folder: Path, world: World, *, style: str = "folders", **top: Any) -> Path:
    folder.mkdir(parents=True)
    entries = []
    for c in range(len(world.poses)):
        rotation, center = world.poses[c, :3, :3], -world.poses[c, :3, :3].T @ world.poses[c, :3, 3]
        right, down, forward = rotation
        matrix = np.eye(4)
        matrix[:3, :4] = np.stack([right, -down, -forward, center], axis=1)
        K = world.Ks[c]
        entry = {"transform_matrix": matrix.tolist(), "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        if style == "videos":
            write_video(folder / f"cam{c}.mp4", world.pictures[:, c])
            entries.append({"file_path": f"cam{c}.mp4", **entry})
            continue
        write_frames(folder / "images" / f"cam{c}", world.pictures[:, c])
        times = range(len(world.pictures)) if style == "timed" else [None]
        for t in times:
            path = f"images/cam{c}" + ("" if t is None else f"/{t:04d}.png")
            entries.append({"file_path": path, **entry, **({} if t is None else {"time": t / 10})})
    write_ply(folder / "points.ply", world.xyz, world.rgb)
    tests = [e["file_path"] for e in entries if "cam0" in e["file_path"]]
    data = {"w": SIZE[0], "h": SIZE[1], "fps": 25, "ply_file_path": "points.ply", "test_filenames": tests, **top}
    (folder / "transforms.json").write_text(json.dumps({**data, "frames": entries}))
    return folder


def project_nerfstudio(folder: Path, camera: int, points: Array) -> Array:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    entry = next(f for f in frames if f"cam{camera}" in f["file_path"])
    inside = np.linalg.inv(np.array(entry["transform_matrix"])) @ np.concatenate([points, np.ones((20, 1))], 1).T
    depth = -inside[2]
    right, up = inside[0] / depth, inside[1] / depth
    return np.stack([entry["fl_x"] * right + entry["cx"], entry["cy"] - entry["fl_y"] * up], 1)


@dataclass(frozen=True)
class Layout:
    """A writer, the layout's projection, and what the reader is expected to say."""

    scheme: str
    write: Callable[[Path, World], Path]
    project: Callable[[Path, int, Array], Array]
    names: Callable[[int], str]
    test: tuple[str, ...]
    has_points: bool
    fps: float = 30.0


def _variant(writer: Callable[..., Path], **options: Any) -> Callable[[Path, World], Path]:
    return lambda folder, world: writer(folder, world, **options)


N3DV, COLMAP, NERF = "cam{:02d}".format, "cam{:02d}".format, "cam{}".format
LAYOUTS = {
    "n3dv": Layout("n3dv", write_n3dv, project_llff, N3DV, ("cam00",), False),
    "n3dv images": Layout("n3dv", _variant(write_n3dv, style="images"), project_llff, N3DV, ("cam00",), False),
    "n3dv folders": Layout("n3dv", _variant(write_n3dv, style="folders"), project_llff, N3DV, ("cam00",), False),
    "n3dv instants": Layout("n3dv", _variant(write_n3dv, style="instants"), project_llff, N3DV, ("cam00",), False),
    "meetroom": Layout("meetroom", write_meetroom, project_llff, "cam_{}".format, ("cam_0",), False),
    "enerf": Layout("enerf", write_enerf, project_enerf, "{:02d}".format, ("00",), False),
    "panoptic": Layout("panoptic", write_panoptic, project_panoptic, "cam{}".format, ("cam0",), True),
    "colmap text": Layout("colmap", _variant(write_colmap, binary=False), project_colmap, COLMAP, (), True),
    "colmap folders": Layout(
        "colmap", _variant(write_colmap, binary=False, frames="folders"), project_colmap, COLMAP, (), True
    ),
    "nerfstudio": Layout("nerfstudio", write_nerfstudio, project_nerfstudio, NERF, ("cam0",), False, 25),
    "nerfstudio timed": Layout(
        "nerfstudio", _variant(write_nerfstudio, style="timed"), project_nerfstudio, NERF, ("cam0",), False, 25
    ),
    "nerfstudio videos": Layout(
        "nerfstudio", _variant(write_nerfstudio, style="videos"), project_nerfstudio, NERF, ("cam0",), False
    ),
}  # fmt: skip
