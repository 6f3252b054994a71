"""One calibrated camera, as the readers of calibrations give it, which pictures are its, and the rig of several."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, files_in, folders_in, images_in
from gsstream.input.recordings.depth_maps import FOLDER
from gsstream.input.recordings.foreign import left_out, warn
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.recorded import Recording

#: Pictures of a size that differs by less than this share lost or gained a border, and were not scaled.
BORDER = 0.03


@dataclass(frozen=True, slots=True)
class RigCamera:
    """Pose and lens."""

    name: str  # in the calibration; that of the pictures may differ
    w2c: FloatArray | None  # [4, 4] world to camera, OpenCV axes; None: only its lens is calibrated
    #: [3, 3] pixels, corner origin; without a size: in units of the longer side, from the middle of the picture.
    K: FloatArray
    lens: Lens  # how rays bend
    size: tuple[int, int] | None  # (width, height) that K is for; None: not stored
    border: bool = True  # whether pictures may have lost or gained a border

    def intrinsics(self, size: tuple[int, int]) -> FloatArray:
        """Return K for pictures of this size. Raises SourceError when they show another part of the view."""
        if self.size is None:
            out: FloatArray = np.diag([max(size), max(size), 1.0]) @ self.K
            out[:2, 2] += np.array(size) / 2
            return out
        across, down = size[0] / self.size[0], size[1] / self.size[1]
        # Sides that were scaled are rounded to whole pixels; near the calibrated size, a pixel may be a border.
        near = max(abs(across - 1), abs(down - 1)) < BORDER
        if abs(across - down) < (1e-3 if near else 1 / min(size)) * down:
            scaled: FloatArray = np.diag([across, down, 1.0]) @ self.K
            return scaled
        if near and self.border:
            return self.K
        raise SourceError(
            f"camera {self.name!r} is calibrated for pictures of {self.size[0]} x {self.size[1]}, but those found are "
            f"{size[0]} x {size[1]}: another part of the view; calibrate with pictures of that shape"
        )


def assembled_rig(
    folder: Path, where: Path, cameras: Mapping[str, RigCamera], clips: Mapping[str, Clip], **more: Any
) -> Recording:
    """Return the recording of these cameras, by the names of their clips; ``more`` are other fields of a recording.

    Intrinsics are brought to the size of the pictures, which a warning says where that is another.
    Raises SourceError for pictures that show another part of the view.
    """
    flat = [name for name in clips if cameras[name].w2c is None]
    clips = {name: clip for name, clip in clips.items() if name not in flat}
    left_out(str(where), "without a pose (calibrate the rig, too: only their lenses are known)", flat, len(clips))
    sizes = {name: clip.size for name, clip in clips.items()}
    try:
        Ks = np.stack([cameras[name].intrinsics(size) for name, size in sizes.items()])
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from error
    other = {name: cameras[name].size for name, size in sizes.items() if cameras[name].size not in (None, size)}
    if other:
        name, stated = next((name, size) for name, size in other.items() if size is not None)
        warn(
            f"{where}: {len(other)} of {len(sizes)} cameras are calibrated for another size than their pictures have "
            f"({name}: {stated[0]} x {stated[1]} for {sizes[name][0]} x {sizes[name][1]}); the intrinsics are brought "
            "to the size of the pictures"
        )
    poses = [w2c for name in clips if (w2c := cameras[name].w2c) is not None]
    return Recording(
        name=folder.resolve().name,
        where=str(where),
        rig=Cameras(tuple(clips), np.stack(poses), Ks, *next(iter(sizes.values()))),
        clips=clips,
        lenses={name: cameras[name].lens for name in clips if not cameras[name].lens.is_identity},
        sizes=sizes,
        **more,
    )


def say_unused(where: Path, clips: Mapping[str, Clip], named: Collection[Path] = ()) -> None:
    """Warn of pictures and videos beside those of these cameras that no camera has.

    ``named``: those of which something was said already.
    """
    used = {path for clip in clips.values() for path in clip.files} | set(named)
    known = used | {path.parent for path in used}
    homes = Counter(place for clip in clips.values() for place in {path.parent for path in clip.files})
    films = {path.parent for path in used if path.suffix.lower() in VIDEO_SUFFIXES}
    alone = {place for place, shared in homes.items() if shared == 1 and len(clips) > 1 and place not in films}
    found = [path for place in sorted(films & set(homes)) for path in files_in(place, VIDEO_SUFFIXES)]
    for parent in sorted({place.parent for place in alone}):
        beside = (folder for folder in folders_in(parent) if folder not in known and folder.name != FOLDER)
        found += [folder for folder in beside if images_in(folder)]
    for place in sorted(set(homes) - films - alone):
        found += images_in(place)
    if other := list(dict.fromkeys(path.name for path in found if path not in known)):
        some = ", ".join(other[:8]) + (", ..." if len(other) > 8 else "")
        warn(f"{where}: pictures without a pose are left out: {some} ({len(other)}); {len(clips)} cameras stay")


def opencv_lens(values: Sequence[float], fisheye: bool, where: str) -> Lens:
    """Return the lens of OpenCV's coefficients: k1, k2, p1, p2, k3, k4, k5, k6, or k1 to k4 of a fisheye.

    There are 12 coefficients with s1 to s4 of a thin prism; where there are 14, the tilt must be zero. Zeros alone are
    no lens, however many.
    """
    if fisheye and len(values) == 4:
        return Lens("fisheye", tuple(values))
    if fisheye or (any(values) and (len(values) not in (4, 5, 8, 12, 14) or any(values[12:]))):
        counts = "0, 4, 5, 8 or 12 coefficients (k1, k2, p1, p2, k3 to k6, s1 to s4)"
        kind = "4 coefficients of a fisheye" if fisheye else counts
        raise SourceError(f"{where}: expected {kind}, got {list(values)}")
    k1, k2, p1, p2, *more = (*values, 0.0, 0.0, 0.0, 0.0)[: max(4, len(values))]
    s1, s2, s3, s4 = more[4:8] if len(values) >= 12 else (0.0,) * 4
    return Lens("radial", (k1, k2, *more[:4]), (p1, p2), (s1, s2, s3, s4))


def matched(calibrated: Sequence[str], pictures: Sequence[str]) -> dict[str, str]:
    """Return name of pictures -> name in the calibration: equal, else alike but for signs, else of one number.

    Names are taken for equal or alike where two or more are; numbers, where they leave no camera or no pictures over.
    Raises SourceError when no way fits.
    """
    rules: tuple[Callable[[str], str], ...] = (
        lambda name: name,
        lambda name: re.sub(r"[^a-z0-9]", "", name.lower().rsplit(".", 1)[0]),
        lambda name: str(int((re.findall(r"\d+", name) or ["-1"])[0])),
    )
    most: dict[str, str] = {}
    for rule in rules:
        known = {rule(name): name for name in calibrated}
        found = {name: known[rule(name)] for name in pictures if rule(name) in known}
        if len(known) < len(calibrated) or len(set(found.values())) < len(found) or len(found) < 2:
            continue
        whole = len(found) in (len(calibrated), len(pictures))
        if len(found) > len(most) and (whole or rule is not rules[-1]):
            most = found
    if most:
        return most
    raise SourceError(
        f"the cameras of the calibration ({', '.join(calibrated)}) do not fit the pictures ({', '.join(pictures)}): "
        "name videos or folders of pictures as the calibration names its cameras"
    )
