"""Points of other programs: colours by type and range, headers as they come, and files that unpack to gigabytes."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from gsstream.core.errors import SourceError
from gsstream.input.recordings.pointfiles import read_ply_points, read_points
from gsstream.input.recordings.sync import RecordingWarning

ORANGE = (1.0, 0.5, 0.0)
COLOURS = {
    "bytes": ("uchar", "255 128 0"), "float": ("float", "1 0.5 0"), "float to 255": ("float", "255 128 0"),
    "16 bits": ("ushort", "65535 32768 0"), "bytes in 16 bits": ("ushort", "255 128 0"), "int": ("int", "255 128 0"),
    "double": ("double", "1.0 0.5 0.0"), "uint16": ("uint16", "65535 32768 0"),
}  # fmt: skip


def text(
    path: Path, kind: str, colour: str, names: tuple[str, ...] = ("red", "green", "blue"), end: str = "\n"
) -> Path:
    head = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    head += [*(f"property {kind} {name}" for name in names), "end_header"]
    path.write_bytes(end.join([*head, *(f"{i} 0 0 {colour}" for i in range(3)), ""]).encode())
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("name", COLOURS)
def test_an_orange_is_orange_however_it_is_stored(tmp_path: Path, name: str, end: str) -> None:
    cloud = read_ply_points(text(tmp_path / "a.ply", *COLOURS[name], end=end))
    assert np.allclose(cloud.rgb, ORANGE, atol=1 / 255)
    assert np.array_equal(cloud.xyz[:, 0], (0, 1, 2))
    assert cloud.rgb.dtype == np.float32


@pytest.mark.parametrize("name", ["bytes", "float", "16 bits", "double"])
def test_a_binary_file_says_the_same(tmp_path: Path, name: str) -> None:
    kind, colour = COLOURS[name]
    dtype = {"uchar": "u1", "float": "<f4", "ushort": "<u2", "double": "<f8"}[kind]
    table = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((c, dtype) for c in ("red", "green", "blue"))])
    for channel, value in zip(("red", "green", "blue"), colour.split(), strict=True):
        table[channel] = float(value)
    head = text(tmp_path / "a.ply", kind, colour).read_bytes().partition(b"end_header\n")[0]
    head = head.replace(b"ascii", b"binary_little_endian") + b"end_header\n"
    (tmp_path / "b.ply").write_bytes(head + table.tobytes())
    assert np.allclose(read_ply_points(tmp_path / "b.ply").rgb, ORANGE, atol=1 / 255)


def test_colours_by_other_names_and_harmonics_are_read_and_others_are_said(tmp_path: Path) -> None:
    for names in (("Red", "Green", "Blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        assert np.allclose(
            read_ply_points(text(tmp_path / "a.ply", "uchar", "255 128 0", names)).rgb, ORANGE, atol=0.01
        )
    splats = text(tmp_path / "b.ply", "float", "1.7724539 0 -1.7724539", ("f_dc_0", "f_dc_1", "f_dc_2"))
    assert np.allclose(read_ply_points(splats).rgb, ORANGE, atol=1e-6)
    with pytest.warns(RecordingWarning, match="no colours among .*cyan, magenta, yellow; the points are grey"):
        grey = read_ply_points(text(tmp_path / "c.ply", "uchar", "1 2 3", ("cyan", "magenta", "yellow")))
    assert (grey.rgb == 0.5).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_ply_points(text(tmp_path / "d.ply", "float", "1 0 0", ("nx", "ny", "nz")))


@pytest.mark.parametrize(
    ("kind", "colour"),
    [
        ("float", "nan 0 0"),
        ("float", "-0.1 0 0"),
        ("float", "256 0 0"),
        ("int", "65536 0 0"),
        ("int", "-1 0 0"),
        ("float", "inf 0 0"),
        ("uchar", "256 0 0"),
        ("uchar", "0.5 0 0"),
        ("uchar", "nan 0 0"),
    ],
)
def test_colours_of_no_known_range_are_refused(tmp_path: Path, kind: str, colour: str) -> None:
    with pytest.raises(SourceError, match=r"a\.ply: (colours of the type|the rows cannot be read: vertex 0)"):
        read_ply_points(text(tmp_path / "a.ply", kind, colour))


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path: Path) -> None:
    """1.6 MB of zeros; the memory of a process of its own is bounded."""
    path = tmp_path / "points_frame0.npz"
    np.savez_compressed(path, xyz=np.zeros((20_000_000, 3), np.float32), rgb=np.zeros((20_000_000, 3), np.uint8))
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from gsstream.input.recordings.pointfiles import read_points\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n    read_points(Path(sys.argv[1]), 'recording')\n"
        "except Exception as error:\n    print(type(error).__name__, error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=600, check=True
    )
    said, grown = done.stdout.strip().rsplit("\n", 1)
    assert "SourceError" in said
    assert "more than 100 times as many" in said
    assert int(grown) < 50_000, "kilobytes"


def test_points_that_pack_well_are_still_read(tmp_path: Path) -> None:
    path = tmp_path / "points_frame0.npz"
    np.savez_compressed(path, xyz=np.zeros((100_000, 3)), rgb=np.zeros((100_000, 3), np.uint8))
    assert len(read_points(path, "recording")) == 100_000
