"""One stream in the formats of others, written by export and by tools of others, and how each is read back."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.play import Playback, export
from gsstream.player.activated import Activated, activated
from gsstream.player.ply import read_ply
from gsstream.player.rows import tracked

Scene = Gaussians[FloatArray]
#: Frames of one format as its reader gives them.
Read = Callable[[], Iterable[Any]]
#: antimatter15's .splat, which splats4D takes: 32 bytes for each Gaussian.
SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


@dataclasses.dataclass(frozen=True)
class Written:
    """One format: its files, how they are read, what makes Gaussians of a frame that was read, degree of harmonics."""

    name: str
    files: Sequence[Path]
    read_by: str
    read: Read | None
    scene: Callable[[Any], Scene] | None
    degree: int
    to_recording: FloatArray = dataclasses.field(default_factory=lambda: np.eye(4))


def raw(means: Any, quats: Any, scales: Any, opacities: Any, harmonics: Any) -> Scene:
    """Return what our renderer takes, from values after activation (quats xyzw)."""
    alphas = np.clip(np.asarray(opacities, np.float64), 1e-7, 1 - 1e-7)
    return Gaussians(
        means=np.asarray(means, np.float32),
        quats=np.asarray(quats, np.float32)[:, [3, 0, 1, 2]],
        scales=np.log(np.maximum(np.asarray(scales, np.float64), 1e-20)).astype(np.float32),
        opacities=np.log(alphas / (1 - alphas)).astype(np.float32),
        sh0=np.asarray(harmonics, np.float32)[:, :1],
        shN=np.asarray(harmonics, np.float32)[:, 1:],
    )


def numbered(stream: Path, frames: Sequence[int], folder: Path, degree: int) -> Iterator[Written]:
    """PLY, and what splat-transform makes of it."""
    plys = export(stream, folder / "ply", "ply", frames=frames)
    yield Written("numbered PLY", plys, "gsstream", lambda: (read_ply(file)[0] for file in plys), lambda s: s, degree)
    spz = export(stream, folder / "spz", "spz", frames=frames)
    converter = shutil.which("splat-transform")
    if converter is None:
        print("no splat-transform: SPZ is not read back, and there is no SPZ 4", file=sys.stderr)
        yield Written("numbered SPZ 3", spz, "-", None, None, degree)
        return
    fourth = [folder / "spz4" / file.name for file in spz]
    fourth[0].parent.mkdir()
    for ply, file in zip(plys, fourth, strict=True):
        _run(converter, "--overwrite", ply, file)
    for name, files in (("numbered SPZ 3", spz), ("numbered SPZ 4", fourth)):

        def scene(number: int, files: Sequence[Path] = files) -> Scene:
            _run(converter, "--overwrite", files[number], folder / "back.ply")
            with warnings.catch_warnings():  # an opacity of 255 comes back as infinite
                warnings.simplefilter("ignore")
                return read_ply(folder / "back.ply")[0]

        yield Written(name, files, "splat-transform", None, scene, degree)


def gltf(stream: Path, frames: Sequence[int], folder: Path, degree: int) -> Written:
    """Binary glTF, by the reader of fourdgs, which keeps harmonics as bytes."""
    import fourdgs

    files = export(stream, folder / "glb", "glb", frames=frames)
    data = files[0].read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    back = np.array(document["scenes"][0]["extras"]["toRecording"]).reshape(4, 4).T

    def read() -> Iterator[Any]:
        return (fourdgs.from_gltf(str(file)).gaussians for file in files)

    return Written("numbered GLB", files, "fourdgs", read, _of_set, degree, back)


def usd(stream: Path, frames: Sequence[int], folder: Path, degree: int) -> Written:
    """OpenUSD with time samples, by usd-core."""
    from pxr import Usd, UsdVol

    (file,) = export(stream, folder / "usd", "usd", frames=frames)

    def read() -> Iterator[Any]:
        stage = Usd.Stage.Open(str(file))
        splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
        attributes = [
            splat.GetPositionsAttr(),
            splat.GetOrientationsAttr(),
            splat.GetScalesAttr(),
            splat.GetOpacitiesAttr(),
            splat.GetRadianceSphericalHarmonicsCoefficientsAttr(),
        ]
        for frame in frames:
            means, quats, scales, opacities, harmonics = (np.array(a.Get(frame)) for a in attributes)
            yield means, quats, scales, opacities, harmonics.reshape(len(means), -1, 3)

    stage = Usd.Stage.Open(str(file))
    back = np.array(stage.GetRootLayer().customLayerData["toRecording"]).T
    return Written("OpenUSD", [file], "usd-core", read, lambda values: raw(*values), degree, back)


def lives(stream: Path, frames: Sequence[int], folder: Path, degree: int, fps: float) -> Written:
    """4dgs as export writes it."""
    import fourdgs

    (file,) = export(stream, folder / "4dgs", "4dgs", frames=frames)
    header = fourdgs.read(str(file)).header
    back = np.array(header.attributes["to_recording"].split(), np.float64).reshape(4, 4)

    def read() -> Iterator[Any]:
        scene = fourdgs.read(str(file))
        for frame in frames:
            yield scene.gaussians, scene.gaussians.state_at((frame - frames[0] + 0.5) / fps)

    def scene(values: Any) -> Scene:
        splats, state = values
        rows = state["indices"]
        names = ["positions", "rotations", "scales", "colors", *(["sh"] if degree else [])]
        part = dataclasses.replace(splats, **{name: getattr(splats, name)[rows] for name in names})
        return _of_set(part)

    return Written("4dgs, export", [file], "fourdgs", read, scene, degree, back)


def deltas(stream: Path, frames: Sequence[int], folder: Path, fps: float) -> Written:
    """4dgs with deltas to one key frame, by the writer of fourdgs, which leaves harmonics above degree 0 out."""
    from fourdgs.keyframe_delta_file import decode_streamed, render_at, write_sequence
    from fourdgs.keyframe_delta_writer import KeyframeDeltaOptions, Sample
    from fourdgs.model import GaussianSet

    samples: list[Any] = []
    ids, made = np.empty(0, np.int64), 0
    end = len(frames) / fps
    with Playback(stream) as playback:
        for _, scene, source in tracked(playback, frames):
            fresh = source < 0
            ids = np.where(fresh, made + np.cumsum(fresh) - 1, ids[source] if len(ids) else 0)
            made += int(fresh.sum())
            splats = activated(playback.meta.world.gaussians(scene))
            number, start = len(splats), len(samples) / fps
            colours = np.concatenate([0.5 + SH0 * splats.harmonics[:, 0], splats.opacities[:, None]], 1)
            rest = (np.zeros((number, 3)), np.full(number, start), np.full(number, 1e4), np.zeros(number))
            splat_set = GaussianSet(
                splats.means, splats.scales, splats.quats, colours.astype(np.float32), *rest, np.full(number, end)
            )
            samples.append(Sample(start, ids, splat_set))
    file = folder / "deltas.4dgs"
    file.write_bytes(write_sequence(samples, end, kd=KeyframeDeltaOptions(keyframe_every=0)))

    def read() -> Iterator[Any]:
        decoded = decode_streamed(file.read_bytes())
        for number in range(len(frames)):
            yield render_at(decoded, number / fps)

    def scene_of(state: Any) -> Scene:
        colours = (state["rgb"][:, None] - 0.5) / SH0
        return raw(state["centers"], state["rotations"], state["scales"], state["opacity"], colours)

    return Written("4dgs, deltas", [file], "fourdgs", read, scene_of, 0)


def splats4d(stream: Path, frames: Sequence[int], folder: Path, fps: float) -> Written | None:
    """splats4D with its own settings; .splat knows no harmonics. None where it is not installed or refuses."""
    program = shutil.which("splat4d")
    if program is None:
        print("no splat4d (pip install splats4d)", file=sys.stderr)
        return None
    (folder / "splat").mkdir()
    with Playback(stream) as playback:
        for number, frame in enumerate(frames):
            splats = activated(playback.meta.world.gaussians(playback.state_at(frame)))
            (folder / "splat" / f"frame_{number:04d}.splat").write_bytes(_splat(splats))
    file = folder / "stream.splat4d"
    try:
        _run(program, "encode", "-i", folder / "splat", "-o", file, "--fps", f"{fps:g}")
    except subprocess.CalledProcessError as error:
        print(f"splat4d refuses these frames: {error.stderr.strip()[-200:]}", file=sys.stderr)
        return None

    def scene(number: int) -> Scene:
        target = folder / "one.splat"
        _run(program, "decode", file, "--frame", str(number), "-o", target)
        table = np.fromfile(target, SPLAT)
        quats = (table["quats"].astype(np.float32) - 128)[:, [1, 2, 3, 0]]
        colours = (table["rgba"][:, None, :3] / 255 - 0.5) / SH0
        return raw(table["means"], quats, table["scales"], table["rgba"][:, 3] / 255, colours)

    return Written("splats4D", [file], "splat4d", None, scene, 0)


def _splat(splats: Activated) -> bytes:
    table = np.empty(len(splats), SPLAT)
    table["means"], table["scales"] = splats.means, splats.scales
    colours = np.concatenate([0.5 + SH0 * splats.harmonics[:, 0], splats.opacities[:, None]], 1)
    table["rgba"] = np.rint(255 * np.clip(colours, 0, 1))
    table["quats"] = np.clip(np.rint(128 * splats.quats[:, [3, 0, 1, 2]] + 128), 0, 255)
    return table.tobytes()


def _of_set(splats: Any) -> Scene:
    """Gaussians from those of fourdgs."""
    number, rest = splats.positions.shape[0], splats.sh.shape[1] // 3 if splats.sh is not None else 0
    first = (splats.colors[:, None, :3].astype(np.float64) - 0.5) / SH0
    bands = splats.sh.astype(np.float64) if rest else np.empty((number, 0))
    bands = bands.reshape(number, 3, rest).transpose(0, 2, 1) * (8 / 255) - 4
    harmonics = np.concatenate([first, bands], 1)
    return raw(splats.positions, splats.rotations, splats.scales, splats.colors[:, 3], harmonics)


def _run(*command: str | Path) -> None:
    subprocess.run(list(map(str, command)), check=True, capture_output=True, text=True)
