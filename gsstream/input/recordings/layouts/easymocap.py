"""ENeRF-Outdoor and other EasyMocap recordings: intri.yml, extri.yml, images/00/000000.jpg (or videos/00.mp4).

OpenCV file storage. ``names``: camera ids. intri.yml: ``K_00`` 3 x 3 in pixels with (0, 0) in the *centre* of the first
pixel (OpenCV's convention; half a pixel is added on reading), ``dist_00`` (or ``D_00``) k1, k2, p1, p2, k3, ..., and
``W_00``, ``H_00``, the size that K is for, where it is not that of the pictures. extri.yml: ``Rot_00`` 3 x 3 (or
``R_00``, a rotation vector) and ``T_00``: world to camera, OpenCV axes, usually metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.input.recordings.clips import clip_at, folders_in, images_in
from gsstream.input.recordings.foreign import Keys, check_keys, inside, left_out, pixels
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.recorded import Recording
from gsstream.input.recordings.rigs.camera import RigCamera, assembled_rig, opencv_lens
from gsstream.input.recordings.rigs.opencv_yaml import load_storage, numbers_of

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
#: Keys that EasyMocap and EasyVolcap write; near and far planes, bounds and colour matrices belong to rendering.
_INTRI = Keys(read="names K_* dist_* D_* W_* H_*", idle="ccm_*", refused="xi_* model_*")
_EXTRI = Keys(read="names Rot_* R_* T_*", idle="t_* n_* f_* bounds_*", refused="RT_*")


def looks_like(folder: Path) -> bool:
    """Say whether there is an intri.yml beside an extri.yml."""
    return (folder / INTRINSICS).is_file() and (folder / EXTRINSICS).is_file()


def read(folder: Path) -> Recording:
    """Read ENeRF-Outdoor: 18 cameras, 1920 x 1080, 30 frames per second; the test camera is the first, 00 (paper)."""
    intri, extri = load_storage(folder / INTRINSICS), load_storage(folder / EXTRINSICS)
    path = folder / INTRINSICS
    names = intri.get("names")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise SourceError(f"{path}: 'names' must list the cameras")
    for name in names:
        inside(f"{path}: names", name)
    check_keys(str(path), [intri], _INTRI)
    check_keys(str(folder / EXTRINSICS), [extri], _EXTRI)
    there = [place.name for place in folders_in(folder / "images") if images_in(place)]
    places = {name: (folder / "images" / name, folder / "videos" / name) for name in sorted({*names, *there})}
    clips = {name: clip for name, (a, b) in places.items() if (clip := clip_at(a) or clip_at(b)) is not None}
    if not clips:
        raise SourceError(f"{folder}: no pictures of any camera; expected images/NAME/000000.jpg or videos/NAME.mp4")
    cameras = {name: _camera(folder, intri, extri, name=name, pictures=clip.size) for name, clip in clips.items()}
    known = {name: camera for name, camera in cameras.items() if camera is not None}
    left_out(str(path), "without pictures", sorted(set(names) - set(clips)), len(clips))
    lost = [name for name in clips if name not in known]
    left_out(str(path), "without one of K, Rot (or R) and T", lost, len(known))
    seen = {name: clips[name] for name in known}
    return assembled_rig(folder, path, known, seen, test=(next(iter(seen)),), licence="see the data set")


def _camera(
    folder: Path, intri: dict[str, Any], extri: dict[str, Any], *, name: str, pictures: tuple[int, int]
) -> RigCamera | None:
    """The camera of a name; None where its matrix or its pose is not there."""
    turns = [key for key in (f"Rot_{name}", f"R_{name}") if key in extri]
    if f"K_{name}" not in intri or f"T_{name}" not in extri or not turns:
        return None
    inner, outer = str(folder / INTRINSICS), str(folder / EXTRINSICS)
    turn = numbers_of(outer, extri, turns[0], counts=(9 if turns[0].startswith("Rot") else 3,))
    w2c = np.eye(4)
    w2c[:3, :3] = from_rotation_vector(turn) if len(turn) == 3 else turn.reshape(3, 3)
    w2c[:3, 3] = numbers_of(outer, extri, f"T_{name}", counts=(3,))
    bent = next((key for key in (f"dist_{name}", f"D_{name}") if key in intri), None)
    coefficients = [] if bent is None else numbers_of(inner, intri, bent).tolist()
    stated = [key for key in (f"W_{name}", f"H_{name}") if key in intri]
    sides = [pixels(inner, key, float(numbers_of(inner, intri, key, counts=(1,))[0])) for key in stated]
    return RigCamera(
        name=name,
        w2c=w2c,
        K=from_pixel_centers(numbers_of(inner, intri, f"K_{name}", counts=(9,)).reshape(3, 3)),
        lens=opencv_lens(coefficients, False, f"{inner}: {bent}"),
        size=(sides[0], sides[1]) if len(sides) == 2 else pictures,
        border=False,
    )
