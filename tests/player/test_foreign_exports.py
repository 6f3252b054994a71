"""glTF, OpenUSD and 4dgs are read back by libraries of others, and drawn beside our own picture."""

from __future__ import annotations

import dataclasses
import json
import struct
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from moving_scenes import moving_packets
from test_export import FAR, NEAR, turned
from test_player import NUMPY, make_scene, make_stream

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, OutputError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.world import IDENTITY
from gsstream.packet import StreamWriter
from gsstream.player.activated import activated
from gsstream.player.export import export
from gsstream.player.four_dgs import lives
from gsstream.player.glb import glb_bytes
from gsstream.player.playback import Playback
from gsstream.player.render import render

fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is not installed (the extra fourdgs)")
pytest.importorskip("pxr", reason="usd-core is not installed (the extra usd)")
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def scene_of(sh_rest: int, number: int = 150) -> Gaussians:
    """Colours stay between 0 and 1, and what depends on the view is strong."""
    scene = make_scene(5, number, sh_rest)
    return dataclasses.replace(scene, sh0=(0.6 * np.tanh(scene.sh0)).astype(np.float32), shN=1.5 * scene.shN)


def raw(means, quats, scales, opacities, harmonics) -> Gaussians:
    """Values after activation (quats xyzw) as our renderer takes them."""
    opacities = np.clip(np.asarray(opacities, np.float64), 1e-9, 1 - 1e-9)
    return Gaussians(
        means=np.float32(means),
        quats=np.float32(np.asarray(quats)[:, [3, 0, 1, 2]]),
        scales=np.log(np.maximum(scales, 1e-30)).astype(np.float32),
        opacities=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh0=np.float32(harmonics[:, :1]),
        shN=np.float32(harmonics[:, 1:]),
    )


def worst_psnr(playback: Playback, frame: int, theirs: Gaussians, to_recording: np.ndarray) -> float:
    """Decibels, over all cameras, between our picture of a frame and ours of what a file holds."""
    found = []
    for split in ("train", "test"):
        rig = playback.meta.world.cameras(playback.cameras(split))
        moved = dataclasses.replace(rig, viewmats=rig.viewmats @ to_recording)
        for view in range(len(rig)):
            ours = render(playback.state_at(frame), playback.cameras(split), view, renderer=NUMPY)
            error = np.mean((np.clip(ours, 0, 1) - np.clip(render(theirs, moved, view, renderer=NUMPY), 0, 1)) ** 2)
            found.append(-10 * np.log10(max(error, 1e-12)))
    return min(found)


def read_glb(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """JSON and attributes of the only primitive, byte by byte as glTF says."""
    magic, version, whole, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, whole, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    rest, kind = struct.unpack_from("<I4s", data, 20 + size)
    blob = data[28 + size :]
    assert (kind, rest, document["buffers"][0]["byteLength"]) == (b"BIN\0", len(blob), len(blob))
    found = {}
    (primitive,) = document["meshes"][0]["primitives"]
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width, number = SIZES[accessor["type"]], accessor["count"]
        dtype = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
        part = blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values = np.frombuffer(part, dtype).reshape(number, width)
        assert view["byteOffset"] % 4 == 0
        assert values[0].nbytes % 4 == 0
        found[name] = values[:, 0] if width == 1 else values
    return document, found


def splats_of(found: dict[str, np.ndarray]) -> Gaussians:
    name = "KHR_gaussian_splatting:"
    bands = [found[key] for key in found if key.startswith(f"{name}SH_DEGREE")]
    parts = (found[f"{name}{part}"] for part in ("ROTATION", "SCALE", "OPACITY"))
    return raw(found["POSITION"], *parts, np.stack(bands, 1))


def place_of(document: dict) -> np.ndarray:
    return np.array(document["scenes"][0]["extras"]["toRecording"]).reshape(4, 4).T


@pytest.mark.parametrize("sh_rest", [0, 3, 8, 15])
def test_a_glb_is_what_the_extension_says(tmp_path, sh_rest):
    stream = make_stream(tmp_path / "s.gss", 2, scene=scene_of(sh_rest))
    _, file = export(stream, tmp_path / "out", "glb")
    document, found = read_glb(file.read_bytes())
    with Playback(stream) as playback:
        ours, scene = activated(playback.state_at(1)), playback.state_at(1)
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    stated = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    assert primitive["extensions"]["KHR_gaussian_splatting"] == stated
    assert len(found) == 5 + sh_rest + 1
    assert found["KHR_gaussian_splatting:OPACITY"] == pytest.approx(1 / (1 + np.exp(-scene.opacities)), rel=1e-6)
    assert found["KHR_gaussian_splatting:SCALE"] == pytest.approx(np.exp(scene.scales), rel=1e-5)
    assert np.linalg.norm(found["KHR_gaussian_splatting:ROTATION"], axis=1) == pytest.approx(1, abs=1e-6)
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == found["POSITION"].min(0).tolist()
    assert position["max"] == found["POSITION"].max(0).tolist()
    # Points of programs without the extension: linear values, which the curve of sRGB takes to the colours.
    linear = found["COLOR_0"][:, :3] / 65535
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert shown == pytest.approx(np.clip(0.5 + SH0 * scene.sh0[:, 0], 0, 1), abs=2e-3)
    # By the library of 4dgs, which keeps coefficients as 256 steps from -4 to 4.
    theirs = fourdgs.from_gltf(str(file)).gaussians
    assert theirs.sh_degree == ours.degree
    assert np.array_equal(theirs.positions, found["POSITION"])
    assert np.array_equal(theirs.colors[:, 3], found["KHR_gaussian_splatting:OPACITY"])
    if sh_rest:
        bytes_ = theirs.sh.reshape(len(ours), 3, sh_rest).transpose(0, 2, 1)
        coefficients = np.stack([found[key] for key in found if "SH_DEGREE" in key][1:], 1)
        assert bytes_ * (8 / 255) - 4 == pytest.approx(coefficients, abs=4.001 / 255)


def looked_up(stream) -> np.ndarray:
    """The direction, in the recording's coordinates, that is up for the cameras."""
    with Playback(stream) as playback:
        rig = playback.meta.world.cameras(playback.cameras("train"))
    return -rig.viewmats[:, 1, :3].mean(0)


@pytest.mark.parametrize("origin", ["recording", "local"])
@pytest.mark.parametrize("world", [IDENTITY, turned(NEAR)])
def test_up_is_up_and_the_way_back_to_the_recording_is_stated(tmp_path, world, origin):
    """Degree 3, in pictures: a wrong sign of harmonics would look plausible."""
    from pxr import Usd, UsdGeom

    stream = make_stream(tmp_path / "s.gss", 2, world, scene_of(15))
    up = looked_up(stream)
    for kind, axis in (("glb", 1), ("usd", 2), ("4dgs", 2)):
        (*_, file) = export(stream, tmp_path / "out", kind, origin=origin)
        if kind == "glb":
            document, found = read_glb(file.read_bytes())
            theirs, back = splats_of(found), place_of(document)
        elif kind == "usd":
            stage = Usd.Stage.Open(str(file))
            assert UsdGeom.GetStageUpAxis(stage) == "Z"
            back = np.array(stage.GetRootLayer().customLayerData["toRecording"]).T
            theirs = usd_scene(stage, 1)
        else:
            scene = fourdgs.read(str(file))
            back = np.array(scene.header.attributes["to_recording"].split(), float).reshape(4, 4)
            theirs = living(scene.gaussians, 1.5 / 25)
        assert np.linalg.det(back) == pytest.approx(1), "a rotation and an offset: the unit is the recording's"
        assert (np.linalg.inv(back[:3, :3]) @ up)[axis] > 0.9 * np.linalg.norm(up)
        assert np.any(back[:3, 3] != 0) == (origin == "local" and world != IDENTITY)
        with Playback(stream) as playback:
            found_db = worst_psnr(playback, 1, theirs, back)
        print(kind, origin, world == IDENTITY, found_db)
        assert found_db > (44 if kind == "4dgs" else 90)


def usd_scene(stage, time) -> Gaussians:
    from pxr import UsdVol

    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    degree = splat.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    values = [
        np.array(attribute.Get(time))
        for attribute in (splat.GetPositionsAttr(), splat.GetScalesAttr(), splat.GetOpacitiesAttr())
    ]
    # A quaternion by its named parts: how USD lays them out in memory is its own matter.
    quats = [[*q.GetImaginary(), q.GetReal()] for q in splat.GetOrientationsAttr().Get(time)]
    harmonics = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(time))
    return raw(values[0], np.array(quats), values[1], values[2], harmonics.reshape(len(quats), (degree + 1) ** 2, 3))


def living(splats, time: float) -> Gaussians:
    """What the library of 4dgs reconstructs at a time."""
    state = splats.state_at(time)
    rows, rest = state["indices"], splats.sh.shape[1] // 3
    bands = splats.sh[rows].astype(float).reshape(len(rows), 3, rest).transpose(0, 2, 1) * (8 / 255) - 4
    first = (splats.colors[rows, :3].astype(float) - 0.5) / SH0
    harmonics = np.concatenate([first[:, None], bands], 1)
    return raw(state["centers"], state["orientations"], splats.scales[rows], state["opacity"], harmonics)


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Rows join and leave, frame 4 changes nothing, frame 7 is a key frame with other Gaussians."""
    path = tmp_path_factory.mktemp("moving") / "s.gss"
    with StreamWriter.open(path) as writer:
        for packet in moving_packets(seed=8, frames=10, number=90, sh_rest=15):
            writer.append(packet)
    return path


def frames_of(stream, frames) -> Iterator[tuple[int, Gaussians]]:
    with Playback(stream) as playback:
        for frame in frames:
            yield frame, playback.state_at(frame)


@pytest.mark.parametrize("frames", [range(10), [1, 2, 6, 9], [5]])
def test_usd_has_every_frame_and_says_how_large_before(tmp_path, moving, frames):
    from pxr import Usd, UsdVol

    said: list[str] = []
    (file,) = export(moving, tmp_path / "out", "usd", frames=frames, said=said.append)
    stage = Usd.Stage.Open(str(file))
    prim = stage.GetDefaultPrim()
    splat = UsdVol.ParticleField3DGaussianSplat(prim)
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_scene"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (frames[0], frames[-1])
    assert stage.GetTimeCodesPerSecond() == 30
    for frame, scene in frames_of(moving, frames):
        found = usd_scene(stage, frame)
        # In a stream that keeps its recording's axes, up is that of its camera: -y.
        assert found.means[:, 2] == pytest.approx(-scene.means[:, 1], abs=1e-6)
        assert found.sh0 == pytest.approx(scene.sh0, abs=1e-6)
        assert found.scales == pytest.approx(scene.scales, abs=1e-5)
        low, high = np.array(splat.GetExtentAttr().Get(frame))
        assert (low < found.means.min(0)).all()
        assert (high > found.means.max(0)).all()
        if frame == frames[0]:
            assert np.array_equal(np.array(splat.GetPositionsAttr().Get()), found.means), "asked for no time"
    (sentence,) = said
    told = float(sentence.split()[-2]) * 1e6
    assert abs(told - file.stat().st_size) < 0.06e6 + 0.1 * told


def test_usd_keeps_once_what_never_changes(tmp_path):
    from pxr import Usd, UsdVol

    stream = make_stream(tmp_path / "s.gss", 5)  # means move alone, and not in frame 2
    (file,) = export(stream, tmp_path / "out", "usd")
    stage = Usd.Stage.Open(str(file))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splat.GetPositionsAttr().GetTimeSamples() == [0, 1, 2, 3, 4], "USD interpolates where a sample is missing"
    assert splat.GetExtentAttr().GetTimeSamples() == [0, 1, 2, 3, 4]
    assert splat.GetRadianceSphericalHarmonicsCoefficientsAttr().GetTimeSamples() == []
    with Playback(stream) as playback:
        means, harmonics = playback.state_at(0).means.nbytes, activated(playback.state_at(0)).harmonics.nbytes
    assert file.stat().st_size < 4 * means + harmonics + 11 * means, "frames 1 and 2 share their positions"


@pytest.mark.parametrize("frames", [range(10), [1, 2, 6, 9], [5]])
def test_4dgs_has_every_frame(tmp_path, moving, frames):
    said: list[str] = []
    (file,) = export(moving, tmp_path / "out", "4dgs", frames=frames, said=said.append)
    scene = fourdgs.read(str(file))
    assert scene.header.sh_degree == 3
    assert "were cut to that" in said[0]
    bounds = fourdgs.Bounds.for_profile("default", median_scale=float(np.median(scene.gaussians.scales)))
    for frame, ours in frames_of(moving, frames):
        for moment in (0, 0.5, 0.99):
            theirs = living(scene.gaussians, (frame - frames[0] + moment) / 30)
            assert len(theirs) == len(ours)
            means = np.stack([ours.means[:, 2], -ours.means[:, 0], -ours.means[:, 1]], 1)
            nearest = np.abs(theirs.means[:, None] - means).max(2).argmin(0)
            assert len(set(nearest)) == len(ours)
            assert theirs.means[nearest] == pytest.approx(means, abs=1.1 * bounds.pos)
            assert theirs.scales[nearest] == pytest.approx(ours.scales, abs=1.1 * bounds.scale_rel)
            assert theirs.sh0[nearest] == pytest.approx(
                np.clip(ours.sh0, -0.5 / SH0, 0.5 / SH0), abs=1.1 * bounds.rgb / SH0
            )
    from fourdgs.validate import validate

    assert validate(file.read_bytes()).ok


def test_lives_tell_every_frame_again():
    """Against the frames themselves, for rows that stay, change, go, come and change places."""
    rng = np.random.default_rng(3)
    for _ in range(40):
        rest = int(rng.choice([0, 3, 8, 15]))
        scene, frames, wanted = activated(make_scene(1, int(rng.integers(0, 6)), rest)), [], []
        for index in range(int(rng.integers(1, 7))):
            number, added = len(scene), int(rng.integers(0, 3))
            kept = rng.permutation(number)[: int(rng.integers(0, number + 1))]
            fresh = activated(make_scene(int(rng.integers(1 << 30)), added, rest))
            parts = {
                field.name: np.concatenate([getattr(scene, field.name)[kept], getattr(fresh, field.name)])
                for field in dataclasses.fields(scene)
            }
            scene = dataclasses.replace(scene, **parts)
            source = np.concatenate([kept, np.full(added, -1)]) if index else np.full(len(scene), -1)
            changes = rng.random(len(scene)) < 0.3
            scene = dataclasses.replace(scene, opacities=np.where(changes, rng.random(len(scene)), scene.opacities))
            frames.append((scene, source.astype(np.int64)))
            wanted.append(np.concatenate([scene.means, scene.opacities[:, None]], 1).astype(np.float32))
        table, first, last = lives(frames)
        assert (first < last).all()
        for index, rows in enumerate(wanted):
            there = table[(first <= index) & (index < last)][:, [0, 1, 2, 10]]
            assert sorted(there.tolist()) == sorted(rows.tolist())
        stays = sum(
            int((source >= 0).sum()) and int((rows[source >= 0] == wanted[i][source[source >= 0]]).all(1).sum())
            for i, (rows, (_, source)) in enumerate(zip(wanted[1:], frames[1:], strict=True))
        )
        assert len(table) == sum(map(len, wanted)) - stays, "what stays the same is one life"


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("glb", {"scales": 90.0}, r"1 of 5 Gaussians are larger .*export ply"),
        ("usd", {"scales": 90.0}, r"1 of 5 Gaussians are larger .*export ply"),
        ("4dgs", {"scales": 90.0}, r"1 of 5 Gaussians are larger .*export ply"),
        ("4dgs", {"means": 1e9}, r"the library of 4dgs refuses these frames: .*32 bits.*export ply"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, kind, changes, message):
    scene = make_scene(0, 5, 15)
    for name, value in changes.items():
        getattr(scene, name)[2] = value
    stream = make_stream(tmp_path / "s.gss", 1, scene=scene)
    with pytest.raises(InputError, match=message):
        export(stream, tmp_path / "out", kind)
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("kind", ["glb", "usd", "4dgs"])
def test_a_stream_in_its_recordings_axes_loses_nothing_far_away(tmp_path, kind):
    """Its positions are float32 already, and there is no offset to leave out."""
    scene = make_scene(0, 5, 15)
    scene.means[2] = 1e7
    (file,) = export(make_stream(tmp_path / "s.gss", 1, scene=scene), tmp_path / "out", kind)
    if kind == "glb":
        found = np.linalg.norm(read_glb(file.read_bytes())[1]["POSITION"].astype(float), axis=1)
        assert found.max() == pytest.approx(1e7 * 3**0.5, rel=1e-6)
    assert file.stat().st_size > 0


def test_no_gaussians_are_refused_where_no_reader_takes_them(tmp_path):
    empty = activated(make_scene(0, 0))
    with pytest.raises(InputError, match="no Gaussians; export ply"):
        glb_bytes(empty, np.eye(4))
    from gsstream.player.four_dgs import write_4dgs
    from gsstream.player.usd import write_usd

    with pytest.raises(InputError, match="none of these frames has any"):
        write_4dgs(
            tmp_path / "a.4dgs",
            [(empty, np.empty(0, np.int64))],
            np.array([0.0, 1.0]),
            to_recording=np.eye(4),
            said=print,
        )
    with pytest.raises(InputError, match="frame 3 has no Gaussians"):
        write_usd(tmp_path / "a.usdc", [3], lambda _: empty, fps=1, to_recording=np.eye(4), said=print, progress=print)


@pytest.mark.parametrize("kind", ["glb", "usd", "4dgs"])
def test_mistakes_are_named(tmp_path, moving, kind, monkeypatch, capsys):
    with pytest.raises(InputError, match="frame 10 is not in this stream"):
        export(moving, tmp_path / "out", kind, frames=[10])
    ending = {"usd": "usdc"}.get(kind, kind)
    with pytest.raises(OutputError, match=f"a.{ending}: expected a folder"):
        export(moving, tmp_path / f"a.{ending}", kind)
    far = make_stream(tmp_path / "far.gss", 1, turned(FAR))
    with pytest.raises(InputError, match="--origin local"):
        export(far, tmp_path / "out", kind)
    assert not (tmp_path / "out").exists()
    if kind == "glb":
        return
    for frames in ([], [2, 1], [3, 3]):
        with pytest.raises(InputError, match="one or more in order of time"):
            export(moving, tmp_path / "out", kind, frames=frames)
    with pytest.raises(InputError, match=r"writing .* takes about"):
        export(moving, tmp_path / "out", kind, max_memory=300_000)
    package = {"usd": "pxr", "4dgs": "fourdgs"}[kind]
    monkeypatch.setitem(sys.modules, package, None)
    assert run_command(["export", str(moving), "--format", kind, "--out", str(tmp_path / "out")]) == 2
    assert f"gsstream[{'usd' if kind == 'usd' else 'fourdgs'}]" in capsys.readouterr().err
