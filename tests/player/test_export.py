"""Exports are read back by readers that share no code with the writers."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
import subprocess

import numpy as np
import pytest
from test_player import make_scene, make_stream

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, OutputError
from gsstream.core.world import World
from gsstream.player.export import export
from gsstream.player.playback import Playback
from gsstream.player.ply import ply_bytes
from gsstream.player.spz import spz_bytes

CONVERTER = shutil.which("splat-transform")
needs_converter = pytest.mark.skipif(
    CONVERTER is None, reason="no splat-transform (npm install @playcanvas/splat-transform)"
)

SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


def read_ply(data: bytes) -> dict[str, list[float]]:
    """Vertices of a binary little-endian PLY, written from the format's description: property -> values."""
    lines, at = [], 0
    while not lines or lines[-1] != "end_header":
        stop = data.index(b"\n", at)
        lines.append(data[at:stop].decode("ascii").strip())
        at = stop + 1
    assert lines[0] == "ply"
    assert lines[1] == "format binary_little_endian 1.0"
    words = [line.split() for line in lines[2:-1] if not line.startswith(("comment", "obj_info"))]
    (element,) = [w for w in words if w[0] == "element"]
    properties = [(w[2], w[1]) for w in words if w[0] == "property"]
    row = struct.Struct("<" + "".join(CODES[kind] for _, kind in properties))
    assert row.size == sum(SIZES[kind] for _, kind in properties)
    assert len(data) - at == int(element[2]) * row.size
    table = list(row.iter_unpack(data[at:]))
    return {name: [values[i] for values in table] for i, (name, _) in enumerate(properties)}


def columns(found: dict[str, list[float]], *names: str) -> np.ndarray:
    return np.array([found[name] for name in names], np.float32).T


@pytest.mark.parametrize("sh_rest", [0, 3, 8, 15])
@pytest.mark.parametrize("number", [0, 1, 37])
def test_ply_holds_the_scene_by_the_names_of_3dgs(sh_rest, number):
    scene = make_scene(3, number, sh_rest)
    found = read_ply(ply_bytes(scene))
    assert list(found)[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert list(found)[9 + 3 * sh_rest :] == [
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    for i in range(number):
        assert [found[n][i] for n in "xyz"] == scene.means[i].tolist()
        assert [found[f"f_dc_{c}"][i] for c in range(3)] == scene.sh0[i, 0].tolist()
        for channel in range(3):
            for k in range(sh_rest):
                assert found[f"f_rest_{channel * sh_rest + k}"][i] == scene.shN[i, k, channel]
        assert found["opacity"][i] == scene.opacities[i]
        assert [found[f"scale_{a}"][i] for a in range(3)] == scene.scales[i].tolist()
        assert [found[f"rot_{a}"][i] for a in range(4)] == scene.quats[i].tolist()


def test_sequence_names_files_times_and_cameras(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    written = export(stream, tmp_path / "out", "sequence", frames=[1, 3])
    described = json.loads((tmp_path / "out" / "sequence.json").read_text())
    assert [tmp_path / "out" / entry["file"] for entry in described["frames"]] == written
    assert [(e["frame"], e["seconds"]) for e in described["frames"]] == [(1, 0.04), (3, 0.12)]
    assert [(c["id"], c["split"]) for c in described["cameras"]][-1] == ("cam3", "test")
    with Playback(stream) as playback:
        for frame, file in zip((1, 3), written, strict=True):
            assert np.array_equal(columns(read_ply(file.read_bytes()), "x", "y", "z"), playback.state_at(frame).means)


def test_mistakes_of_an_export_are_named(tmp_path):
    stream = make_stream(tmp_path / "s.gss", 2)
    with pytest.raises(InputError, match="expected one of ply, spz, glb, sequence, usd, 4dgs"):
        export(stream, tmp_path / "out", "obj")
    with pytest.raises(InputError, match="frame 2"):
        export(stream, tmp_path / "out", "ply", frames=[2])
    assert not (tmp_path / "out").exists()
    scene = make_scene(0, 5)
    scene.scales[2, 1] = 6
    with pytest.raises(InputError, match=r"scales up to 379 units, and 1 of 5 .* export ply"):
        spz_bytes(scene)
    scene = make_scene(0, 5)
    scene.means[2, 1] = -1e7
    with pytest.raises(InputError, match=r"positions up to 8388607, got 1e\+07: .*--origin local"):
        spz_bytes(scene)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"):
        export(stream, tmp_path / "file", "ply")


#: A turn about z whose cosine is 0.6, a world of 2.5 units, moved by so much.
NEAR, FAR = ((10.0, -20.0, 5.0), (5e5, 5.2e6, 300.0))


def turned(offset: tuple[float, float, float]) -> World:
    return World((0.6, -0.8, 0.0, 0.8, 0.6, 0.0, 0.0, 0.0, 1.0), offset, 2.5)


def test_exports_lie_in_the_recordings_coordinates(tmp_path):
    stream = make_stream(tmp_path / "s.gss", 2, turned(NEAR))
    (file, *_) = export(stream, tmp_path / "out", "sequence", frames=[1])
    found, described = read_ply(file.read_bytes()), json.loads((tmp_path / "out" / "sequence.json").read_text())
    with Playback(stream) as playback:
        scene, rig = playback.state_at(1), playback.cameras("train")
    x, y, z = scene.means.T.astype(np.float64)
    moved = np.stack([2.5 * (0.6 * x - 0.8 * y) + 10, 2.5 * (0.8 * x + 0.6 * y) - 20, 2.5 * z + 5], 1)
    assert columns(found, "x", "y", "z") == pytest.approx(moved, abs=1e-5)
    assert columns(found, "scale_0", "scale_1", "scale_2") == pytest.approx(scene.scales + np.log(2.5), abs=1e-5)
    shown = np.array(described["cameras"][0]["viewmat"])
    # A point has the same pixel before and after: its place in the camera only grows by the unit.
    before = rig.viewmats[0, :3, :3] @ scene.means[0] + rig.viewmats[0, :3, 3]
    assert shown[:3, :3] @ moved[0] + shown[:3, 3] == pytest.approx(2.5 * before, abs=1e-5)
    assert described["offset"] == [0, 0, 0]


def test_what_float32_cannot_hold_is_refused_or_written_beside_its_offset(tmp_path):
    """In UTM coordinates a float32 counts half metres."""
    stream = make_stream(tmp_path / "s.gss", 2, turned(FAR))
    with pytest.raises(InputError, match=r"float32.*5\.2e\+06.*--origin local"):
        export(stream, tmp_path / "out", "ply")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="recording or local"):
        export(stream, tmp_path / "out", "ply", origin="away")
    command = ["export", str(stream), "--out", str(tmp_path / "out"), "--format", "sequence", "--origin", "local"]
    assert run_command(command) == 0
    described = json.loads((tmp_path / "out" / "sequence.json").read_text())
    assert described["offset"] == list(FAR)
    data = (tmp_path / "out" / "000000.ply").read_bytes()
    assert b"comment offset 500000.0 5200000.0 300.0\n" in data
    with Playback(stream) as playback:
        means = turned(FAR).points(playback.state_at(0).means)
    assert columns(read_ply(data), "x", "y", "z") + np.array(FAR) == pytest.approx(means, abs=1e-5)


@needs_converter
def test_splat_transform_reads_our_ply(tmp_path):
    """Through its own reader and writer: the values come back bit by bit."""
    scene = make_scene(7, 60, 15)
    (tmp_path / "ours.ply").write_bytes(ply_bytes(scene))
    command = [CONVERTER, "--overwrite", str(tmp_path / "ours.ply"), str(tmp_path / "theirs.ply")]
    subprocess.run(command, check=True, capture_output=True)
    found = read_ply((tmp_path / "theirs.ply").read_bytes())
    assert np.array_equal(columns(found, "x", "y", "z"), scene.means)
    rest = columns(found, *(f"f_rest_{i}" for i in range(45)))
    assert np.array_equal(rest, scene.shN.transpose(0, 2, 1).reshape(60, 45))
    assert np.array_equal(columns(found, *(f"rot_{i}" for i in range(4))), scene.quats)
    assert np.array_equal(columns(found, "opacity")[:, 0], scene.opacities)


#: Signs of y, z, x; xy, yz, 3zz - 1, xz, xx - yy; y, xyz, y, z, x, z, x (times what is even) where y and z turn.
HALF_TURN = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)


def read_spz(data: bytes) -> dict[str, np.ndarray]:
    """The Gaussians of an SPZ of version 3, byte by byte as its description says, turned to the axes of a PLY."""
    data = gzip.decompress(data)
    magic, version, number, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, version, flags, reserved) == (b"NGSP", 3, 0, 0)
    at, rows = 16, range(number)

    def take(width: int) -> list[bytes]:
        nonlocal at
        at += width * number
        return [data[at - width * (number - i) : at - width * (number - i - 1)] for i in rows]

    steps = [[int.from_bytes(row[i : i + 3], "little", signed=True) for i in (0, 3, 6)] for row in take(9)]
    means = [[x / 2**bits, -y / 2**bits, -z / 2**bits] for x, y, z in steps]
    alphas = [row[0] / 255 for row in take(1)]
    colors = [[(byte / 255 - 0.5) / 0.15 for byte in row] for row in take(3)]
    scales = [[byte / 16 - 10 for byte in row] for row in take(3)]
    quats = []
    for (packed,) in map(struct.Struct("<I").unpack, take(4)):
        others = [(packed >> shift) & 1023 for shift in (20, 10, 0)]
        parts = [(-1) ** (part >> 9) * (part & 511) / 511 * 2**-0.5 for part in others]
        parts.insert(packed >> 30, max(0.0, 1 - sum(part**2 for part in parts)) ** 0.5)
        quats.append([parts[3], parts[0], -parts[1], -parts[2]])
    rest = (degree + 1) ** 2 - 1
    shN = [[HALF_TURN[i // 3] * (byte - 128) / 128 for i, byte in enumerate(row)] for row in take(3 * rest)]
    assert at == len(data)
    found = {"means": means, "alphas": alphas, "colors": colors, "scales": scales, "quats": quats, "shN": shN}
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize("sh_rest", [0, 3, 8, 15])
@pytest.mark.parametrize("spread", [1e-3, 0.6, 500.0])
def test_spz_is_the_scene_to_its_precision(sh_rest, spread):
    scene = make_scene(4, 200, sh_rest, spread)
    scene.quats[:4] = np.eye(4)
    scene.scales[0] = -15
    found = read_spz(spz_bytes(scene))
    assert np.abs(found["means"] - scene.means).max() <= 2.0**-22 * np.abs(scene.means).max()
    assert np.abs(found["alphas"] - 1 / (1 + np.exp(-scene.opacities.astype(float)))).max() < 0.501 / 255
    assert np.abs(found["colors"] - np.clip(scene.sh0[:, 0], -1 / 0.3, 1 / 0.3)).max() < 0.501 / 255 / 0.15
    assert np.abs(found["scales"] - np.maximum(scene.scales, -10)).max() < 0.501 / 16
    cosine = np.abs((found["quats"] * scene.quats).sum(1)) / np.linalg.norm(scene.quats, axis=1)
    assert cosine.min() > 1 - 1e-5
    steps = np.where(np.arange(3 * sh_rest) < 9, 4.5, 8.5) / 128
    assert (np.abs(found["shN"] - scene.shN.reshape(200, -1)) <= steps).all()
    assert read_spz(spz_bytes(make_scene(0, 0, sh_rest)))["means"].size == 0


@needs_converter
def test_splat_transform_reads_our_spz_as_we_do(tmp_path):
    stream = make_stream(tmp_path / "s.gss", 2)
    (file,) = export(stream, tmp_path / "out", "spz", frames=[1])
    subprocess.run([CONVERTER, "--overwrite", str(file), str(tmp_path / "b.ply")], check=True, capture_output=True)
    theirs, ours = read_ply((tmp_path / "b.ply").read_bytes()), read_spz(file.read_bytes())
    assert columns(theirs, "x", "y", "z") == pytest.approx(ours["means"], abs=1e-6)
    assert columns(theirs, "scale_0", "scale_1", "scale_2") == pytest.approx(ours["scales"], abs=1e-6)
    assert columns(theirs, *(f"f_dc_{i}" for i in range(3))) == pytest.approx(ours["colors"], abs=1e-6)
    quats = columns(theirs, *(f"rot_{i}" for i in range(4)))
    assert np.abs((quats * ours["quats"]).sum(1)).min() > 1 - 1e-6
    number, rest = len(quats), ours["shN"].shape[1] // 3
    shN = columns(theirs, *(f"f_rest_{i}" for i in range(3 * rest))).reshape(number, 3, rest).transpose(0, 2, 1)
    assert shN.reshape(number, -1) == pytest.approx(ours["shN"], abs=1e-6)
