"""Export decoded frames to files that other programs open: 3DGS PLY, SPZ, glTF, OpenUSD, 4dgs."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from gsstream.core.errors import InputError, OutputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.memory import limited_memory
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.core.world import IDENTITY, World, rig_similarity
from gsstream.player.activated import Activated, activated
from gsstream.player.four_dgs import require_fourdgs, write_4dgs
from gsstream.player.glb import AXES, glb_bytes
from gsstream.player.playback import Playback
from gsstream.player.ply import write_ply
from gsstream.player.rows import tracked
from gsstream.player.spz import spz_bytes
from gsstream.player.usd import require_usd, write_usd

Colour: TypeAlias = tuple[float, float, float]

#: Formats of one file per frame -> suffix; a sequence has a description beside the PLYs.
PER_FRAME = {"ply": ".ply", "spz": ".spz", "glb": ".glb", "sequence": ".ply"}
#: Formats of one file for all frames -> name of the file.
WHOLE = {"usd": "stream.usdc", "4dgs": "stream.4dgs"}
FORMATS = (*PER_FRAME, *WHOLE)
#: From axes forward, left, up to those that a format prescribes; other formats hold those of the recording.
UPRIGHT = {"glb": AXES, "usd": np.eye(3), "4dgs": np.eye(3)}
#: Endings of files that somebody may take ``out`` to be.
_SUFFIXES = (".ply", ".spz", ".glb", ".json", ".usd", ".usda", ".usdc", ".4dgs")


def export(
    stream: str | os.PathLike[str],
    out: str | os.PathLike[str],
    kind: str,
    *,
    frames: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
    max_memory: int | None = None,
    origin: Literal["recording", "local"] = "recording",
    said: Callable[[str], None] | None = None,
) -> list[Path]:
    """Write one file per frame, or one for all, into the folder ``out``; returns the files.

    Arguments:
        stream: file to read.
        out: folder to write.
        progress: called with (frames written, frames in all).
        kind: ``ply``; ``spz``; ``glb``: binary glTF; ``sequence``: PLYs and ``sequence.json`` with frame indices,
            times and the cameras; ``usd`` and ``4dgs``: one file, whose frames must be in order of time.
        frames: frame indices; default: all up to the first damaged packet.
        max_memory: bytes that a frame, or a file of many, may take at most; default: see ``gsstream.core.memory``.
        origin: ``recording``: the recording's coordinates; ``local``: the same axes and unit, but positions relative
            to the world's offset, which files state. The files hold float32, which is too coarse for a scene far from
            the recording's origin. Formats that say which way is up are turned so that it is, about the same origin.
        said: called with sentences about the size of a file before it is written, and about what is lost.

    Raises InputError for an unknown format or frame, for what the format cannot hold, for a package that is
    missing and beyond ``max_memory``, PacketError for a damaged stream (without ``frames``: once the files before the
    damage are written), OutputError when the folder cannot be written.
    """
    _check(kind, Path(out))
    folder = Path(out)
    with limited_memory(max_memory), Playback(stream) as playback:
        sound, damage = playback.sound() if frames is None else (frames, None)
        chosen = list(sound)
        for frame in chosen:
            playback.entry(frame)
        world = _world_of_files(playback, chosen, kind, origin)
        tell = progress or _quiet
        files = [f"{frame:06d}{PER_FRAME[kind]}" for frame in chosen] if kind in PER_FRAME else [WHOLE[kind]]
        written = [folder / name for name in files]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if kind in WHOLE:
                _write_whole(playback, chosen, world, written[0], said or _quiet, tell)
            else:
                write = _writer(kind, playback.meta.world, world, origin)
                backgrounds = _write_each(playback, chosen, world, files=written, write=write, tell=tell)
                if kind == "sequence":
                    described = _description(playback, chosen, backgrounds, world)
                    (folder / "sequence.json").write_text(described, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
    if damage is not None:
        raise damage
    return written


def _check(kind: str, out: Path) -> None:
    """Raise InputError for a format that is not known or lacks its package, OutputError for the name of a file."""
    if kind not in FORMATS:
        raise InputError(f"cannot export to {kind!r}: expected one of {', '.join(FORMATS)}")
    if out.suffix.lower() in (*_SUFFIXES, ".html") and not out.is_dir():
        raise OutputError(f"{out}: expected a folder for the files, got the name of a file")
    if kind == "usd":
        require_usd()
    elif kind == "4dgs":
        require_fourdgs()


def _writer(kind: str, recording: World, world: World, origin: str) -> Callable[[Path, Gaussians[FloatArray]], None]:
    """Return what writes a scene, in the coordinates of ``world``, to a file of its own."""
    if kind == "spz":
        return lambda path, scene: _write(path, spz_bytes(scene))
    if kind == "glb":
        back = _back(recording, world)
        return lambda path, scene: _write(path, glb_bytes(activated(scene), back))
    comments = [f"offset {' '.join(map(repr, recording.offset))}"] if origin == "local" else []
    return lambda path, scene: write_ply(path, scene, comments)


def _back(recording: World, world: World) -> FloatArray:
    """[4, 4] from the coordinates of a file to those of the recording."""
    back, matrix = recording.after(world.inverse()), np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = back.scale * back.matrix, back.offset
    return matrix


def _quiet(*_: object) -> None:
    """Tell nobody."""


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _write_each(
    playback: Playback,
    frames: Sequence[int],
    world: World,
    files: Sequence[Path],
    write: Callable[[Path, Gaussians[FloatArray]], None],
    tell: Callable[[int, int], None],
) -> list[Colour]:
    """Write a file of each frame; return what is behind each."""
    backgrounds: list[Colour] = []
    for frame, file in zip(frames, files, strict=True):
        write(file, world.gaussians(playback.state_at(frame)))
        backgrounds.append(playback.meta.background)
        tell(len(backgrounds), len(frames))
    return backgrounds


def _write_whole(
    playback: Playback,
    frames: Sequence[int],
    world: World,
    path: Path,
    said: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> None:
    """Write a file of all frames; its format is that of its name."""
    fps, back = playback.meta.fps, _back(playback.meta.world, world)
    if not frames or list(frames) != sorted(set(frames)):
        raise InputError(f"{path.name} holds many frames: expected one or more in order of time, got {list(frames)}")
    if path.name == WHOLE["usd"]:

        def scene_at(frame: int) -> Activated:
            return activated(world.gaussians(playback.state_at(frame)))

        write_usd(path, frames, scene_at, fps=fps, to_recording=back, said=said, progress=progress)
        return

    def scenes() -> Iterator[tuple[Activated, IntArray]]:
        for done, (_, scene, source) in enumerate(tracked(playback, frames), 1):
            yield activated(world.gaussians(scene)), source
            progress(done, len(frames))

    times = (np.array([*frames, frames[-1] + 1], np.float64) - frames[0]) / fps
    write_4dgs(path, scenes(), times, to_recording=back, said=said)


def _world_of_files(playback: Playback, frames: Sequence[int], kind: str, origin: str) -> World:
    """The world that files are written in. Raises InputError where float32 would round positions visibly."""
    world = playback.meta.world
    if kind in UPRIGHT:
        # A stream's own axes are forward, left, up, unless it keeps those of its recording.
        axes = rig_similarity(playback.meta.train).matrix if world.is_identity else np.eye(3)
        turn = UPRIGHT[kind] @ axes.T @ world.matrix.T
        world = World(tuple(turn.ravel().tolist())).after(world)
    if origin == "local":
        return replace(world, offset=IDENTITY.offset)
    if origin != "recording":
        raise InputError(f"origin: expected recording or local, got {origin!r}")
    scene = playback.state_at(frames[0]) if frames else None
    if scene is None or len(scene) == 0 or playback.meta.world.is_identity:
        return world
    step = float(np.spacing(np.float32(np.abs(world.points(scene.means)).max())))
    smallest = world.scale * float(np.exp(np.median(scene.scales.min(1))))
    if step > smallest:
        raise InputError(
            f"files hold positions as float32; this far from the recording's origin they are rounded to {step:.2g} "
            f"units, and half of the Gaussians are thinner than {smallest:.2g}: write positions relative to "
            f"({', '.join(f'{value:.6g}' for value in world.offset)}) by --origin local"
        )
    return world


def _description(playback: Playback, frames: Sequence[int], backgrounds: Sequence[Colour], world: World) -> str:
    meta = playback.meta
    cameras = [
        {
            "id": name,
            "split": split,
            "width": rig.width,
            "height": rig.height,
            "viewmat": view.tolist(),
            "K": K.tolist(),
        }
        for split, rig in (("train", world.cameras(meta.train)), ("test", world.cameras(meta.test)))
        for name, view, K in zip(rig.ids, rig.viewmats, rig.Ks, strict=True)
    ]
    first = backgrounds[0] if backgrounds else meta.background
    files = [
        {"frame": frame, "seconds": frame / meta.fps, "file": f"{frame:06d}.ply"}
        | ({} if behind == first else {"background": list(behind)})  # a lamp was switched
        for frame, behind in zip(frames, backgrounds, strict=True)
    ]
    data = {
        "format": "3DGS PLY, one file per frame",
        "fps": meta.fps,
        "background": list(first),
        "viewmat": "world to camera, OpenCV axes",
        "frames": files,
        "cameras": cameras,
        "offset": (np.array(meta.world.offset) - np.array(world.offset)).tolist(),
    }
    return json.dumps(data, indent=1) + "\n"
