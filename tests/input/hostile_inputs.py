"""Inputs of a few bytes that ask for gigabytes or minutes: written here, read by commands, measured.

``python -m tests.input.hostile_inputs`` prints memory and processor time of each, as docs/results/extremes.md has them.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from gsstream.input.recordings.open import DEMO_FOLDER

SIGNATURE = b"\x89PNG\r\n\x1a\n"
Write = Callable[[Path], None]


class Hostile(NamedTuple):
    """How an input is written into an empty folder, and the command that reads it there."""

    write: Write
    command: tuple[str, ...]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def zeros(size: int) -> bytes:
    """A zlib stream of many zero bytes, made piece by piece."""
    packer = zlib.compressobj(9)
    piece = bytes(1 << 20)
    return (
        b"".join([packer.compress(piece) for _ in range(size >> 20)])
        + packer.compress(bytes(size & 0xFFFFF))
        + packer.flush()
    )


def png(
    path: Path, size: tuple[int, int], depth: int = 8, colour: int = 2, *, data: bytes = b"", more: bytes = b""
) -> None:
    """A picture by its parts: ``more`` chunks behind the header, and all zeros where no ``data`` is given."""
    channels = {0: 1, 2: 3, 6: 4}[colour]
    body = data or zeros(size[1] * (size[0] * channels * depth // 8 + 1))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0))
    path.write_bytes(SIGNATURE + head + more + chunk(b"IDAT", body) + chunk(b"IEND", b""))


def black_jpeg(path: Path, side: int) -> None:
    Image.new("L", (side, side)).save(path, format="JPEG", quality=50)


def demo(edit: Callable[[Path, dict[str, Any]], None]) -> Write:
    """The demo with what ``edit`` does to its files."""

    def write(folder: Path) -> None:
        shutil.copytree(DEMO_FOLDER, folder, dirs_exist_ok=True)
        data = json.loads((folder / "cameras.json").read_text())
        edit(folder, data)
        (folder / "cameras.json").write_text(json.dumps(data))

    return write


def picture(change: Write) -> Hostile:
    """One picture of the demo is made another."""

    def edit(folder: Path, data: dict[str, Any]) -> None:
        path = folder / (data["cameras"][1]["frames"] % 5)
        path.unlink()
        change(path)

    return Hostile(demo(edit), VALIDATE)


def pictures(change: Write, declared: tuple[int, int] | None = None) -> Hostile:
    """All cameras' first pictures, of one instant, where the pictures or cameras.json say the size."""

    def write(folder: Path) -> None:
        data = json.loads((DEMO_FOLDER / "cameras.json").read_text())
        for entry in data["cameras"][:3]:
            (folder / entry["id"]).mkdir()
            change(folder / entry["id"] / "000000.png")
            entry["frames"] = f"{entry['id']}/%06d.png"
            entry["width"], entry["height"] = declared or (160, 120)
        if declared is not None:
            (folder / "cameras.json").write_text(json.dumps(data | {"frames": 1, "cameras": data["cameras"][:3]}))

    return Hostile(write, VALIDATE if declared else PREPARE)


def points(change: Write) -> Hostile:
    return Hostile(demo(lambda folder, _: change(folder / "points_frame0.npz")), RUN)


def calibration(change: Callable[[dict[str, Any]], Any]) -> Hostile:
    return Hostile(demo(lambda _, data: change(data)), VALIDATE)


def transforms(entries: int, moving: bool) -> Hostile:
    """Very many entries of nerfstudio, each with a picture that is there."""

    def write(folder: Path) -> None:
        Image.new("RGB", (8, 8)).save(folder / "a.png")
        frames = []
        for i in range(entries):
            (folder / f"{i}.png").symlink_to("a.png")
            pose = np.eye(4)
            pose[0, 3] = i if moving else i % 3
            frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist(), "time": i / 10})
        (folder / "transforms.json").write_text(json.dumps({"fl_x": 8.0, "w": 8, "h": 8, "frames": frames}))

    return Hostile(write, VALIDATE)


def archive(members: dict[str, bytes]) -> Write:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
            for name, data in members.items():
                out.writestr(name, data)

    return write


def array(shape: tuple[int, ...], kind: str, data: bytes = b"") -> bytes:
    """An npy file that announces a shape."""
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + data


def zero_points(count: int) -> Write:
    """As many points in the origin, which pack to a thousandth."""
    return lambda path: np.savez_compressed(path, xyz=np.zeros((count, 3)), rgb=np.zeros((count, 3), np.uint8))


def ply(count: int, rows: bytes, head: str = "") -> Write:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    text = f"ply\nformat binary_little_endian 1.0\n{head}element vertex {count}\n{names}end_header\n"
    return lambda path: path.write_bytes(text.encode() + rows) and None


def still(change: Write, name: str = "points.ply") -> Hostile:
    """A still scene of nerfstudio with points."""

    def write(folder: Path) -> None:
        frames = []
        for i in range(3):
            shutil.copy(next(DEMO_FOLDER.glob("*/*.jpg")), folder / f"{i}.jpg")
            pose = np.eye(4)
            pose[0, 3] = i
            frames.append({"file_path": f"{i}.jpg", "transform_matrix": pose.tolist()})
        data = {"fl_x": 150.0, "w": 160, "h": 120, "ply_file_path": name, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(data))
        change(folder / name)

    return Hostile(write, RUN)


def recipe(text: str) -> Hostile:
    command = ("run", "--source", "demo", "--method", "s2gs", "--recipe", "recipe.yaml", "--out", "out")
    return Hostile(lambda folder: (folder / "recipe.yaml").write_text(text) and None, command)


def nested(depth: int) -> Any:
    return lambda data: data.update(notes=json.loads("[" * depth + "]" * depth))


VALIDATE = ("scene", "validate", ".", "--no-features")
PREPARE = ("scene", "prepare", ".", "--out", "out")
RUN = ("run", "--source", ".", "--method", "s2gs", "--frames", "1", "--set", "data.leak=points", "--out", "out")
LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
HUGE = 10**12

INPUTS: dict[str, Hostile] = {
    "the demo, as it is": Hostile(demo(lambda *_: None), VALIDATE),
    "PNG of 13,000 x 13,000 for one picture": picture(lambda p: png(p, (13_000, 13_000))),
    "RGBA of 18,000 x 9,900 for one picture": picture(lambda p: png(p, (18_000, 9_900), 8, 6)),
    "grey of 16 bits, 12,000 x 12,000, for one picture": picture(lambda p: png(p, (12_000, 12_000), 16, 0)),
    "RGB of 16 bits, 20,000 x 20,000, for one picture": picture(lambda p: png(p, (20_000, 20_000), 16, 2)),
    "PNG that claims 2^31 pixels a side": picture(lambda p: png(p, ((1 << 31) - 1,) * 2, data=b"x")),
    "PNG that claims 65,535 pixels a side": picture(lambda p: png(p, (65_535, 65_535), data=b"x")),
    "JPEG of 13,000 x 13,000 for one picture": picture(lambda p: black_jpeg(p, 13_000)),
    "text chunk of 200 MB": picture(lambda p: png(p, (160, 120), more=chunk(b"zTXt", b"k\0\0" + zeros(200 << 20)))),
    "profile of 200 MB": picture(lambda p: png(p, (160, 120), more=chunk(b"iCCP", b"k\0\0" + zeros(200 << 20)))),
    "international text of 200 MB": picture(
        lambda p: png(p, (160, 120), more=chunk(b"iTXt", b"k\0\1\0\0\0" + zeros(200 << 20)))
    ),
    "100,000 text chunks": picture(lambda p: png(p, (160, 120), more=chunk(b"tEXt", b"k\0v") * 100_000)),
    "PNG whose data unpack to 500 MB": picture(lambda p: png(p, (160, 120), data=zeros(500 << 20))),
    "PNG of 16 bits whose data unpack to 500 MB": picture(lambda p: png(p, (160, 120), 16, data=zeros(500 << 20))),
    "10,000 pictures of an animation": picture(
        lambda p: png(
            p,
            (160, 120),
            more=chunk(b"acTL", struct.pack(">II", 10_000, 0))
            + chunk(b"fcTL", struct.pack(">IIIIIHHBB", 0, 160, 120, 0, 0, 1, 1, 0, 0)) * 10_000,
        )
    ),
    "half a picture": picture(lambda p: p.write_bytes(next(DEMO_FOLDER.glob("*/*.jpg")).read_bytes()[:900]) and None),
    "PostScript for a picture": picture(lambda p: p.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n") and None),
    "a folder for a picture": picture(lambda p: p.mkdir()),
    "/dev/zero for a picture": picture(lambda p: p.symlink_to("/dev/zero")),
    "first pictures of 13,000 x 13,000": pictures(lambda p: png(p, (13_000, 13_000))),
    "first pictures of 16 bits, 20,000 x 20,000": pictures(lambda p: png(p, (20_000, 20_000), 16, 2)),
    "13,000 x 13,000 in cameras.json, too": pictures(lambda p: png(p, (13_000, 13_000)), (13_000, 13_000)),
    "points that unpack to 1.6 GB": points(zero_points(60_000_000)),
    "2.5 million points in one place": points(zero_points(2_500_000)),
    "points that announce 10^12 rows": points(
        archive({"xyz.npy": array((HUGE, 3), "<f8", bytes(24)), "rgb.npy": array((HUGE, 3), "|u1", bytes(3))})
    ),
    "points of 10^12 rows of no bytes": points(
        archive({"xyz.npy": array((HUGE, 3), "|V0"), "rgb.npy": array((HUGE, 3), "|u1")})
    ),
    "one array for points": points(lambda p: p.write_bytes(array((HUGE, 3), "<f8")) and None),
    "pickled points": points(archive({"xyz.npy": array((1,), "|O", b"cos\nsystem\n"), "rgb.npy": b""})),
    "100,000 arrays of points": points(archive({f"{i}.npy": b"" for i in range(100_000)})),
    "PLY that announces 10^12 points": still(ply(HUGE, bytes(12))),
    "PLY with 100,000 elements": still(ply(1, bytes(12), "".join(f"element e{i} 0\n" for i in range(100_000)))),
    "PLY with a header of 50 MB": still(ply(1, bytes(12), "comment x\n" * 5_000_000)),
    "/dev/zero for points": still(lambda p: p.symlink_to("/dev/zero")),
    "cameras.json of 50 MB": calibration(lambda data: data.update(notes="x" * 50_000_000)),
    "cameras.json of 1,000,000 keys": calibration(lambda data: data.update({str(i): i for i in range(1_000_000)})),
    "cameras.json with 900 brackets": calibration(nested(900)),
    "cameras.json of 10^9 frames": calibration(lambda data: data.update(frames=10**9)),
    "cameras.json of 50,000 cameras": calibration(
        lambda data: data.update(cameras=[data["cameras"][0] | {"id": f"c{i}"} for i in range(50_000)])
    ),
    "transforms.json of a camera that moves, 5,000 pictures": transforms(5_000, moving=True),
    "transforms.json of 20,000 instants": transforms(20_000, moving=False),
    "recipe of 190 KB in one list": recipe("gate: [" + "1, " * 65_000 + "1]\n"),
    "recipe of 9^10 words by references": recipe(LAUGHS),
    "recipe of 5,000 brackets": recipe("a: " + "[" * 5_000 + "]" * 5_000 + "\n"),
    "recipe of 5 MB": recipe("a: " + "x" * 5_000_000 + "\n"),
    "recipe of 200,000 keys": recipe("".join(f"k{i}: 1\n" for i in range(200_000))),
}


#: A small process, since a child counts the memory of the one that started it as its own.
MEASURE = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print()
print(json.dumps([code, used.ru_maxrss / 1e3, used.ru_utime + used.ru_stime]))
"""


def measured(name: str) -> tuple[int, float, float, str]:
    """Exit code, peak of memory in MB, processor seconds and output of the command on an input."""
    command = [sys.executable, "-c", "from gsstream.cli.main import main; main()", *INPUTS[name].command]
    with tempfile.TemporaryDirectory() as folder:
        INPUTS[name].write(Path(folder))
        done = subprocess.run(
            [sys.executable, "-c", MEASURE, *command],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            check=True,
        )
    text, _, told = done.stdout.decode("utf-8", "replace").strip().rpartition("\n")
    code, memory, seconds = json.loads(told)
    return code, memory, seconds, text


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for name in sys.argv[1:] or INPUTS:
        code, memory, seconds, text = measured(name)
        last = text.strip().splitlines()[-1][:150] if text.strip() else ""
        print(
            f"| {name} | {code} | {memory:.0f} | {seconds:.1f} | {'TRACEBACK' if 'Traceback' in text else last} |",
            flush=True,
        )
