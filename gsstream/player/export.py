"""Export decoded frames to files that other programs open: 3DGS PLY, SPZ, or a sequence with a description."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from gsstream.core.errors import InputError, OutputError
from gsstream.core.world import IDENTITY, World
from gsstream.player.playback import Playback
from gsstream.player.ply import write_ply
from gsstream.player.spz import spz_bytes

FORMATS = ("ply", "spz", "sequence")


def export(
    stream: str | os.PathLike[str],
    out: str | os.PathLike[str],
    kind: str,
    *,
    frames: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
    max_memory: int | None = None,
    origin: Literal["recording", "local"] = "recording",
) -> list[Path]:
    """Write one file per frame into the folder ``out``; returns the files.

    Arguments:
        stream: file to read.
        out: folder to write.
        progress: called with (files written, files in all).
        kind: ``ply``; ``spz``; ``sequence``: PLYs and ``sequence.json`` with frame indices, times and the cameras.
        frames: frame indices; default: all up to the first damaged packet.
        max_memory: bytes that decoding a frame may take at most; default: what the format allows.
        origin: ``recording``: the recording's coordinates; ``local``: the same axes and unit, but positions relative
            to the world's offset, which ``sequence.json`` and the headers of the PLYs state. The files hold float32,
            which is too coarse for a scene far from the recording's origin.

    Raises InputError for an unknown format or frame, for what the format cannot hold and beyond ``max_memory``,
    PacketError for a damaged stream (without ``frames``: once the files before the damage are written), OutputError
    when the folder cannot be written.
    """
    if kind not in FORMATS:
        raise InputError(f"cannot export to {kind!r}: expected one of {', '.join(FORMATS)}")
    if Path(out).suffix.lower() in (".ply", ".spz", ".json") and not Path(out).is_dir():
        raise OutputError(f"{out}: expected a folder, which holds one file per frame, got the name of a file")
    folder, written = Path(out), []
    with Playback(stream, max_memory=max_memory) as playback:
        sound, damage = playback.sound() if frames is None else (frames, None)
        chosen = list(sound)
        for frame in chosen:
            playback.entry(frame)
        world = _world_of_files(playback, chosen, origin)
        comments = [f"offset {' '.join(map(repr, playback.meta.world.offset))}"] if origin == "local" else []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for done, frame in enumerate(chosen, 1):
                file = folder / f"{frame:06d}.{'spz' if kind == 'spz' else 'ply'}"
                scene = world.gaussians(playback.state_at(frame))
                if kind == "spz":
                    file.write_bytes(spz_bytes(scene))
                else:
                    write_ply(file, scene, comments)
                written.append(file)
                if progress is not None:
                    progress(done, len(chosen))
            if kind == "sequence":
                (folder / "sequence.json").write_text(_description(playback, chosen, world), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
    if damage is not None:
        raise damage
    return written


def _world_of_files(playback: Playback, frames: Sequence[int], origin: str) -> World:
    """The world that files are written in. Raises InputError where float32 would round positions visibly."""
    world = playback.meta.world
    if origin == "local":
        return replace(world, offset=IDENTITY.offset)
    if origin != "recording":
        raise InputError(f"origin: expected recording or local, got {origin!r}")
    scene = playback.state_at(frames[0]) if frames else None
    if scene is None or len(scene) == 0 or world.is_identity:
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


def _description(playback: Playback, frames: Sequence[int], world: World) -> str:
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
    files = [{"frame": frame, "seconds": frame / meta.fps, "file": f"{frame:06d}.ply"} for frame in frames]
    data = {
        "format": "3DGS PLY, one file per frame",
        "fps": meta.fps,
        "background": list(meta.background),
        "viewmat": "world to camera, OpenCV axes",
        "frames": files,
        "cameras": cameras,
        "offset": (np.array(meta.world.offset) - np.array(world.offset)).tolist(),
    }
    return json.dumps(data, indent=1) + "\n"
