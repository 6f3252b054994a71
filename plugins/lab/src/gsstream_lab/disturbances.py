"""What an experiment does to a recording on purpose: options, and pure functions of them and of a seed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from gsstream.core.errors import SourceError, suggest
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.options import validated
from gsstream.input.recordings.transforms import known_camera

LostImage = Literal["hold", "black"]


class Disturbances(BaseModel):
    """What an experiment does to a recording on purpose; the options of ``disturbed:KEY=VALUE,...:URI``."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    gain: float = Field(default=1.0, gt=0, le=4, description="factor on all images, clipped to [0, 1]")
    gain_amplitude: float = Field(
        default=0.0, ge=0, lt=1, description="the factor of frame t lies in gain * (1 -/+ this) (paper: 0.2 to 0.5)"
    )
    gain_pattern: Literal["sine", "random"] = Field(
        default="sine", description="sine: smooth, frame 0 has factor gain; random: uniform, anew in every frame"
    )
    gain_period: float = Field(default=60.0, gt=0, description="frames per period of the sine")
    drift: tuple[str, ...] = Field(
        default=(),
        description="ID@SHARE+... or ID@RED/GREEN/BLUE+...: this camera's images get brighter by this share (below 0: "
        "darker) from each frame to the next, as its exposure or white balance drifts, e.g. c3@-0.0025",
    )
    noise_sigma: float = Field(
        default=0.0, ge=0, le=255, description="noise on training images, 8-bit levels, clipped to [0, 1] (paper: 0-30)"
    )
    noise_frames: int = Field(default=1, ge=1, description="the first so many frames are noisy (paper: frame 0 alone)")
    lost_cameras: tuple[str, ...] = Field(
        default=(), description="ID@A-B+...: this training camera gives nothing in frames A to B - 1, e.g. c3@10-20"
    )
    lost_share: float = Field(
        default=0.0, ge=0, lt=1, description="each training image after frame 0 is lost with this probability"
    )
    lost_as: LostImage = Field(
        default="hold", description="a lost image is: hold: the camera's last one; black: a black one"
    )
    ways: int = Field(
        default=1,
        ge=1,
        le=10_000,
        description="times the recording is gone through: there, back, there again ...; each end is shown once",
    )
    time_offset: tuple[str, ...] = Field(
        default=(), description="ID@FRAMES+...: a camera's frame t + FRAMES stands for frame t, e.g. c3@2+c5@-1"
    )


_KEYS = ("seed", *Disturbances.model_fields)
_PER_CAMERA = ("drift", "lost_cameras", "time_offset")


def parse_disturbances(text: str) -> tuple[Disturbances, int]:
    """Read options and seed from ``"KEY=VALUE,..."``.

    Raises SourceError naming an unknown key or an impossible value.
    """
    values: dict[str, Any] = {}
    for part in text.split(",") if text else ():
        key, equals, value = part.partition("=")
        if not equals or key not in _KEYS:
            near = suggest(key, _KEYS) if equals else ""
            raise SourceError(f"disturbed source: expected KEY=VALUE,..., got {part!r}{near}; keys: {', '.join(_KEYS)}")
        if key in values:
            raise SourceError(f"disturbed source: {key!r} is given twice")
        values[key] = tuple(value.split("+")) if key in _PER_CAMERA else value
    seed = str(values.pop("seed", "0"))
    if not re.fullmatch(r"\d{1,9}", seed):
        raise SourceError(f"disturbed source: seed: expected a whole number from 0, got {seed!r}")
    return validated(Disturbances, values, "disturbed source"), int(seed)


def parse_offsets(entries: Sequence[str], ids: Sequence[str]) -> dict[str, int]:
    """Return camera -> frames, from "ID@FRAMES". Raises SourceError naming the entry."""
    found: dict[str, int] = {}
    for entry in entries:
        name, _, value = entry.rpartition("@")
        if not re.fullmatch(r"-?\d{1,9}", value):
            raise SourceError(
                f"disturbed source: time_offset: expected ID@FRAMES+..., whole frames, e.g. cam03@2, got {entry!r}"
            )
        found[known_camera("disturbed source: time_offset", name, ids, found)] = int(value)
    return found


def parse_drifts(entries: Sequence[str], ids: Sequence[str]) -> dict[str, FloatArray]:
    """Return camera -> shares [3] by which its channels change in a frame, from "ID@SHARE" or "ID@RED/GREEN/BLUE".

    Raises SourceError naming the entry.
    """
    found: dict[str, FloatArray] = {}
    for entry in entries:
        name, _, text = entry.rpartition("@")
        try:
            shares = [float(part) for part in text.split("/")]
        except ValueError:
            shares = []
        if len(shares) not in (1, 3) or not all(-1 < share < 1 for share in shares):
            raise SourceError(
                "disturbed source: drift: expected ID@SHARE+... or ID@RED/GREEN/BLUE+..., shares between -1 and 1, "
                f"e.g. cam03@-0.0025, got {entry!r}"
            )
        camera = known_camera("disturbed source: drift", name, ids, tuple(found))
        found[camera] = np.resize(np.array(shares, np.float32), 3)
    return found


def parse_losses(entries: Sequence[str], ids: Sequence[str]) -> dict[str, list[range]]:
    """Return camera -> frames in which it gives nothing, from "ID@A-B".

    Frame 0 cannot be lost: it is the key picture.
    """
    found: dict[str, list[range]] = {}
    for entry in entries:
        name, _, value = entry.rpartition("@")
        match = re.fullmatch(r"(\d{1,9})-(\d{1,9})", value)
        first, last = (int(n) for n in match.groups()) if match else (0, 0)
        if not 1 <= first < last:
            raise SourceError(
                f"disturbed source: lost_cameras: expected ID@A-B with 1 <= A < B, e.g. cam03@10-20, got {entry!r}; "
                "frame 0 needs every training camera (leave one out with data.train_cameras)"
            )
        found.setdefault(known_camera("disturbed source: lost_cameras", name, ids, ()), []).append(range(first, last))
    return found


def recorded_frame(index: int, frames: int | None) -> int:
    """Return the frame of a recording of so many frames that a film going there and back shows at ``index``."""
    if frames is None or frames == 1:
        return index if frames is None else 0
    way, place = divmod(index, frames - 1)
    return frames - 1 - place if way % 2 else place


def gain_at(options: Disturbances, index: int, rng: Rng) -> float:
    """Return the factor on all images of frame ``index``, in gain * [1 - amplitude, 1 + amplitude]."""
    if options.gain_pattern == "sine":
        wave = math.sin(2 * math.pi * index / options.gain_period)
    else:
        wave = float(rng.numpy("data gain", index).uniform(-1, 1))
    return options.gain * (1 + options.gain_amplitude * wave)


def with_gain(image: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Return the image times a factor, or one for each channel [3]; what exceeds 1 saturates, as in a camera."""
    if np.all(np.asarray(factor) == 1):
        return image
    out: FloatArray = np.clip(image * np.asarray(factor, np.float32), 0, 1)
    return out


def with_noise(image: FloatArray, sigma: float, camera: str, index: int, rng: Rng) -> FloatArray:
    """Return the image with Gaussian noise of ``sigma`` 8-bit levels, clipped to [0, 1] (paper, first-frame noise)."""
    noise = rng.numpy(f"data noise {camera}", index).standard_normal(image.shape, np.float32)
    out: FloatArray = np.clip(image + noise * np.float32(sigma / 255), 0, 1)
    return out


def is_lost(options: Disturbances, losses: dict[str, list[range]], camera: str, index: int, rng: Rng) -> bool:
    """Say whether a training camera gives nothing at a frame; never at frame 0."""
    if index == 0:
        return False
    if any(index in frames for frames in losses.get(camera, ())):
        return True
    return options.lost_share > 0 and bool(rng.numpy(f"data loss {camera}", index).random() < options.lost_share)
