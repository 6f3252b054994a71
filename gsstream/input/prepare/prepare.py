"""``gsstream scene prepare``: from raw synchronised recordings to a scene that a run can take.

Poses by structure from motion on frame 0, or the given ones; pinhole pictures of one size; points thinned to what the
cameras look at. Test cameras take no part in poses, lenses and points of the others.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, OutputError
from gsstream.core.frame import PointCloud
from gsstream.core.names import child
from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import to_bytes
from gsstream.input.prepare.given import GivenRig, read_raw
from gsstream.input.prepare.raw import RawCamera, changes_of, first_frames
from gsstream.input.recordings.calibration import CALIBRATION_FILE, SCHEMA
from gsstream.input.recordings.lens import Lens, Undistortion, undistortion
from gsstream.input.seeds.mapping import Mapping, reconstruct, triangulate
from gsstream.input.seeds.thinning import thin_points

#: Fewer points than this are not written: a run then searches for its own.
MIN_POINTS = 16

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PrepareOptions:
    """How a scene is made."""

    test: tuple[str, ...] | None = None  # ids of test cameras; None: the test cameras of a given calibration
    without: tuple[str, ...] = ()  # ids of cameras that are left out
    model: str = "SIMPLE_RADIAL"  # lens model of structure from motion (a key of ``seeds.mapping.LENSES``)
    each: bool = False  # every camera has a lens of its own; else all share one where all pictures have one size
    frames: int | None = None  # at most so many frames; None: all
    #: Pictures are shrunk to this width; None: to the width of the smallest camera. Pictures of other shapes are shrunk
    #: evenly and cut around their middle.
    width: int | None = None
    max_points: int = 50_000  # points kept
    max_error: float = 2.0  # points with a larger mean reprojection error are dropped, pixels
    fps: float | None = None  # frames per second, where neither a calibration nor videos say; None: 30


@dataclass(frozen=True, slots=True)
class Prepared:
    """What was made: ``mapping`` of all raw cameras, ``rig`` of those that are in the scene, and its points."""

    names: tuple[str, ...]
    left_out: tuple[str, ...]
    test: tuple[str, ...]
    mapping: Mapping
    rig: Cameras
    points: PointCloud | None
    bounds: FloatArray | None
    frames: int
    known_poses: bool


def prepare(raw: Path | str, out: Path, options: PrepareOptions, say: Say, tell: Tell = silent) -> Prepared:
    """Make the scene ``out`` (cameras.json, pictures, points_frame0.npz), with poses and lenses that ``raw`` brings.

    Raises SourceError for a raw recording that cannot be read, InputError when structure from motion fails or finds
    fewer than two training cameras, OutputError when ``out`` exists and is not an empty folder.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(f"{out} exists and is not an empty folder; choose another --out")
    found = read_raw(str(raw)).without(options.without)
    cameras, known = found.cameras, found.known
    names = tuple(camera.name for camera in cameras)
    test = options.test if options.test is not None else known.test if known else ()
    test = tuple(name for name in test if name not in options.without)
    for name in test:
        if name not in names:
            raise InputError(f"--test: no camera {name!r}; cameras: {', '.join(names)}")
    say(f"{len(cameras)} cameras, {len(test)} of them for testing only; {'known' if known else 'unknown'} poses")
    if options.fps and found.fps and abs(options.fps - found.fps) > 0.01:
        say(f"warning: the recording has {found.fps:g} frames per second; --fps {options.fps:g} is not used")
    say("reading frame 0")
    images = first_frames(cameras)
    say(f"matching features of {len(cameras)} pictures; minutes for tens of cameras")
    mapping = _map(cameras, images, known, test=test, options=options, tell=tell)
    kept = [i for i, there in enumerate(mapping.registered) if there]
    if sum(names[i] not in test for i in kept) < 2:
        raise InputError(
            f"structure from motion placed {len(kept)} of {len(names)} cameras; expected at least two for training. "
            "The views may be too far apart or show too little texture: give poses (cameras.json beside the pictures)"
        )
    say(f"placed {len(kept)} of {len(names)} cameras, {len(mapping.xyz)} points")
    target = _target([cameras[i] for i in kept], options)
    lenses = _pinholes([cameras[i] for i in kept], mapping.Ks[kept], [mapping.lenses[i] for i in kept], target)
    for line in changes_of([cameras[i] for i in kept], [lens is not None for _, lens in lenses], target):
        say(line)
    rig = Cameras(tuple(names[i] for i in kept), mapping.viewmats[kept], np.stack([K for K, _ in lenses]), *target)
    cloud = _points(mapping, rig, options)
    points, bounds = cloud if cloud else (None, None)
    say(f"kept {len(cloud[0]) if cloud else 'no'} points; writing pictures")
    _write_pictures([cameras[i] for i in kept], [lens for _, lens in lenses], out, options=options, tell=tell)
    frames = len(cameras[0].span[: options.frames])
    fps, licence = found.fps or options.fps or 30.0, "" if known is None else known.licence
    _write(out, found.title, rig, test=test, found=cloud, frames=frames, fps=fps, licence=licence)
    left_out = tuple(name for i, name in enumerate(names) if i not in kept)
    return Prepared(
        names=names,
        left_out=left_out,
        test=test,
        mapping=mapping,
        rig=rig,
        points=points,
        bounds=bounds,
        frames=frames,
        known_poses=known is not None,
    )


def _map(
    cameras: list[RawCamera],
    images: list[FloatArray],
    known: GivenRig | None,
    test: Sequence[str],
    options: PrepareOptions,
    tell: Tell,
) -> Mapping:
    one_size = len({camera.size for camera in cameras}) == 1
    held = [i for i, camera in enumerate(cameras) if camera.name in test]
    if known is None:
        # Pictures of different sizes come from different lenses.
        shared = one_size and not options.each
        names = [camera.name for camera in cameras]
        return reconstruct(images, model=options.model, shared=shared, held=held, names=names, tell=tell)
    training = [i for i in range(len(cameras)) if i not in held]
    size = _smallest([cameras[i] for i in training])
    tell("undistorting frame 0", 0, 0)
    chosen, lenses = [cameras[i] for i in training], [known.lenses[i] for i in training]
    flat = _pinholes(chosen, known.Ks[training], lenses, size)
    shown = [images[i] if made is None else made.apply(images[i]) for i, (_, made) in zip(training, flat, strict=True)]
    rig = Cameras(
        tuple(camera.name for camera in chosen), known.viewmats[training], np.stack([K for K, _ in flat]), *size
    )
    found = triangulate(np.stack(shown), rig, tell=tell)
    # The test cameras' poses are given; nothing of theirs is used.
    error, seen = np.full(len(cameras), np.nan), np.zeros(len(cameras), np.int64)
    error[training], seen[training] = found.camera_error, found.camera_points
    return replace(
        found, viewmats=known.viewmats, Ks=known.Ks, lenses=known.lenses, camera_error=error, camera_points=seen
    )


def _smallest(cameras: list[RawCamera]) -> tuple[int, int]:
    width, height = (min(camera.size[axis] for camera in cameras) for axis in (0, 1))
    return width, height


def _target(cameras: list[RawCamera], options: PrepareOptions) -> tuple[int, int]:
    width, height = _smallest(cameras)
    if options.width is None or options.width == width:
        return width, height
    if not 0 < options.width < width:
        raise InputError(f"--width: expected 1 to {width} (recordings are never enlarged), got {options.width}")
    return options.width, max(1, round(height * options.width / width))


def _pinholes(
    cameras: Sequence[RawCamera], Ks: FloatArray, lenses: Sequence[Lens], target: tuple[int, int]
) -> list[tuple[FloatArray, Undistortion | None]]:
    """(K, how to undistort) per camera; None: its pictures are taken over as they are."""
    made: dict[tuple[Lens, bytes, tuple[int, int]], Undistortion] = {}  # equal lenses share it
    out: list[tuple[FloatArray, Undistortion | None]] = []
    for camera, K, lens in zip(cameras, Ks, lenses, strict=True):
        if lens.is_identity and target == camera.size:
            out.append((K, None))
            continue
        key = (lens, K.tobytes(), camera.size)
        if key not in made:
            made[key] = undistortion(lens, K, camera.size, target=target, where=f"camera {camera.name!r}")
        out.append((made[key].K, made[key]))
    return out


def _points(mapping: Mapping, rig: Cameras, options: PrepareOptions) -> tuple[PointCloud, FloatArray] | None:
    """Trustworthy points inside the bounds, thinned; bounds [2, 3]: the middle 98 % of them, and a tenth around.

    None where too few matches were found to judge by: cameras far apart have no features in common.
    """
    if len(mapping.xyz) < MIN_POINTS:
        return None
    good = np.isfinite(mapping.xyz).all(1) & (mapping.error <= options.max_error)
    if not good.any():
        raise InputError(
            f"no point has a reprojection error of at most {options.max_error:g} pixels ({len(mapping.xyz)} points "
            "were found): the poses do not fit the pictures, see 'gsstream scene validate'"
        )
    xyz, rgb = mapping.xyz[good], mapping.rgb[good]
    low, high = np.percentile(xyz, [1, 99], axis=0)
    margin = 0.1 * (high - low)
    bounds = np.stack([low - margin, high + margin])
    inside = ((xyz >= bounds[0]) & (xyz <= bounds[1])).all(1)
    colors = rgb[inside].astype(np.float32) / np.float32(255)
    cloud = PointCloud(xyz[inside].astype(np.float64), colors, f"triangulated from {len(rig)} cameras")
    return thin_points(cloud, options.max_points), bounds


def _write_pictures(
    cameras: list[RawCamera], lenses: list[Undistortion | None], out: Path, options: PrepareOptions, tell: Tell
) -> None:
    for number, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        tell("writing pictures: cameras", number, len(cameras))
        folder = child(out, camera.name)
        folder.mkdir(parents=True)
        # Pictures that are copied are read, too: a damaged one is an error here and no surprise later.
        for t, image in enumerate(camera.frames(options.frames)):
            if lens is None and camera.files:
                path = camera.files[t]
                shutil.copyfile(path, folder / f"{t:06d}{path.suffix.lower()}")
                continue
            shown = image if lens is None else lens.apply(image)
            Image.fromarray(to_bytes(shown)).save(folder / f"{t:06d}.png", compress_level=3)


def _write(
    out: Path,
    title: str,
    rig: Cameras,
    test: Sequence[str],
    found: tuple[PointCloud, FloatArray] | None,
    frames: int,
    fps: float,
    licence: str,
) -> None:
    entries: list[dict[str, Any]] = []
    for i, name in enumerate(rig.ids):
        suffix = next((out / name).glob("000000.*")).suffix
        entries.append(
            {
                "id": name,
                "split": "test" if name in test else "train",
                "width": rig.width,
                "height": rig.height,
                "K": rig.Ks[i].tolist(),
                "w2c": rig.viewmats[i].tolist(),
                "frames": f"{name}/%06d{suffix}",
            }
        )
    data = {
        "schema": SCHEMA,
        "name": title,
        "fps": fps,
        "frames": frames,
        "licence": licence,
        **({"bounds": found[1].tolist()} if found else {}),
        "cameras": entries,
    }
    (out / CALIBRATION_FILE).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    if found:
        points = found[0]
        np.savez(out / "points_frame0.npz", xyz=points.xyz, rgb=np.round(points.rgb * 255).astype(np.uint8))
