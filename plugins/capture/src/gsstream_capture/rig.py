"""The rig file: which cameras there are, and where. Addresses may hold passwords, which nothing here ever shows.

::

    fps: 10
    calibration: cameras.json
    cameras:
      - {id: left, url: "rtsp://${CAMERA_USER}:${CAMERA_PASSWORD}@10.0.0.11/stream1"}
      - {id: desk, url: "v4l2:///dev/video0?size=1280x720&fourcc=MJPG", rotate: 90}
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qsl, unquote

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from gsstream.core.errors import ShapeError, SourceError, suggest
from gsstream.core.names import check_camera_ids

#: Bytes of a rig file that are read, and cameras that it may name.
LONGEST, MOST_CAMERAS = 100_000, 256
EXPECTED = "expected rtsp://, http://, v4l2:///dev/... or the path of a video"
_VARIABLE = re.compile(r"\$\{(\w*)\}")
#: Options of a V4L2 address -> those of FFmpeg's input device.
_V4L2 = {"size": "video_size", "fps": "framerate", "fourcc": "input_format"}
#: Names that V4L2 has for pixel formats -> FFmpeg's.
_FOURCC = {"MJPG": "mjpeg", "YUYV": "yuyv422", "NV12": "nv12", "H264": "h264"}


class CameraSpec(BaseModel):
    """One camera of a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str = Field(min_length=1, description="its name in the calibration, and of its folder of pictures")
    url: str = Field(min_length=1, repr=False, description=EXPECTED)
    transport: Literal["tcp", "udp"] = Field(default="tcp", description="how RTSP pictures travel")
    rotate: Literal[0, 90, 180, 270] = Field(default=0, description="degrees to turn its pictures, clockwise")
    delay_ms: float = Field(
        default=0.0, ge=-10_000, le=10_000, description="subtracted from its times: what --check measured"
    )


class Rig(BaseModel):
    """A rig file; ``calibration`` and ``folder`` are relative to it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fps: float = Field(default=10.0, gt=0, le=240, description="instants per second")
    cameras: tuple[CameraSpec, ...] = Field(min_length=1, max_length=MOST_CAMERAS, description="the cameras")
    calibration: Path | None = Field(default=None, description="cameras.json with lenses and poses of these cameras")
    clock: Literal["capture", "arrival"] = Field(
        default="capture", description="pair by the cameras' own clocks where they tell them, or by arrival"
    )
    exposure: Literal["as_it_is", "match"] = Field(
        default="as_it_is", description="'match' divides each camera's colours by its gain in the first instant"
    )
    quality: int = Field(default=95, ge=50, le=100, description="of the JPEG pictures")


@dataclass(frozen=True, slots=True)
class Opening:
    """What PyAV opens: ``target`` with ``format`` (None: by its contents) and options of FFmpeg."""

    target: str = field(repr=False)
    format: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    kind: Literal["rtsp", "http", "device", "file"] = "file"


def read_rig(path: Path, environment: Mapping[str, str] = os.environ) -> Rig:
    """Read a rig file; ``${NAME}`` in an address is taken from the environment.

    Raises SourceError naming the file, the key, what was expected and what is there, passwords left out.
    """
    try:
        text = path.read_text(encoding="utf-8")
        data = YAML(typ="safe", pure=True).load(text) if len(text) <= LONGEST else None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: the rig file cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except (YAMLError, ValueError, RecursionError) as error:
        # What the reader quotes may be the line with the password.
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        raise SourceError(f'{path}{place}: not valid YAML; quote addresses: url: "rtsp://..."') from None
    if not isinstance(data, dict):
        raise SourceError(f"{path}: expected the keys fps, calibration and cameras, got {type(data).__name__}")
    rig = _validated(path, data)
    try:
        check_camera_ids([camera.id for camera in rig.cameras])
    except ShapeError as error:
        raise SourceError(f"{path}: {error}") from error
    ids = [camera.id for camera in rig.cameras]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise SourceError(f"{path}: camera ids must be unique, these occur more than once: {', '.join(twice)}")
    cameras = []
    for number, camera in enumerate(rig.cameras):
        where = f"{path}: cameras[{number}].url"
        url = _filled(camera.url, environment, where)
        opening_of(camera.model_copy(update={"url": url}), path.parent, where)
        cameras.append(camera.model_copy(update={"url": url}))
    calibration = None if rig.calibration is None else path.parent / rig.calibration
    return rig.model_copy(update={"cameras": tuple(cameras), "calibration": calibration})


def _validated(path: Path, data: dict[Any, Any]) -> Rig:
    try:
        return Rig.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    last = str(first["loc"][-1]) if first["loc"] else ""
    model: type[BaseModel] = CameraSpec if first["loc"][:1] == ("cameras",) and len(first["loc"]) > 1 else Rig
    if first["type"] == "extra_forbidden":
        raise SourceError(f"{path}: {place}: unknown key{suggest(last, model.model_fields)}")
    got = "" if last == "url" or isinstance(first["input"], dict | list) else f", got {first['input']!r}"
    meaning = model.model_fields[last].description if last in model.model_fields else "see the how-to on capture"
    raise SourceError(f"{path}: {place}: {first['msg'].lower()}{got} ({meaning})")


def _filled(url: str, environment: Mapping[str, str], where: str) -> str:
    for name in _VARIABLE.findall(url):
        if name not in environment:
            raise SourceError(f"{where}: the environment has no {name or '(empty name)'}; set it: export {name}=...")
    return _VARIABLE.sub(lambda match: environment[match.group(1)], url)


def opening_of(camera: CameraSpec, folder: Path, where: str) -> Opening:
    """Return how PyAV opens a camera; paths are relative to ``folder``. Raises SourceError for another address."""
    scheme, separator, rest = camera.url.partition("://")
    if not separator:
        return Opening(str(folder / camera.url), kind="file")
    if scheme in ("rtsp", "rtsps"):
        # FFmpeg probes as much as it likes: with less, a camera under load failed with "Invalid data found".
        # Its parser holds a picture until the next one begins; gathering.py does not.
        options = {"rtsp_transport": camera.transport, "timeout": "3000000", "fflags": "noparse+nofillin"}
        return Opening(camera.url, None, options, "rtsp")
    if scheme in ("http", "https"):
        return Opening(camera.url, "mpjpeg", {"rw_timeout": "3000000"}, "http")
    if scheme == "v4l2":
        device, _, query = rest.partition("?")
        return Opening(device, "v4l2", _v4l2(query, where), "device")
    raise SourceError(f"{where}: {EXPECTED}, got {scheme[:20]!r}://")


def _v4l2(query: str, where: str) -> dict[str, str]:
    options = {"timestamps": "abs"}  # the kernel's time of a picture, converted to the clock of this machine
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in _V4L2:
            raise SourceError(f"{where}: unknown option {key!r}{suggest(key, _V4L2)}; all: {', '.join(_V4L2)}")
        if key == "size" and not re.fullmatch(r"\d{1,5}x\d{1,5}", value):
            raise SourceError(f"{where}: size: expected WIDTHxHEIGHT, for example 1280x720, got {value[:40]!r}")
        options[_V4L2[key]] = _FOURCC.get(value.upper(), value) if key == "fourcc" else value
    return options


def shown(url: str) -> str:
    """Return an address without user, password and the values of its options."""
    if "://" not in url:
        return url
    scheme, _, rest = url.partition("://")
    before, query, _ = rest.partition("?")
    place, slash, path = before.partition("/")
    host = place.rpartition("@")[2]
    return f"{scheme}://{host}{slash}{path}" + ("?..." if query and scheme != "v4l2" else "")


def without_secrets(text: str, urls: Sequence[str]) -> str:
    """Return a text, as an error of a library, in which no part of these addresses tells a user or a password."""
    for url in urls:
        text = text.replace(url, shown(url))
    secrets = {secret for url in urls for secret in _secrets(url)}
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return text


def _secrets(url: str) -> set[str]:
    if "://" not in url or url.startswith("v4l2://"):
        return set()
    before, _, query = url.partition("://")[2].partition("?")
    user, at, _ = before.partition("/")[0].rpartition("@")
    found = {user, *user.split(":", 1)} if at else set()
    found |= {value for _, value in parse_qsl(query)} | {part.partition("=")[2] for part in query.split("&")}
    found |= {unquote(secret) for secret in found}
    return {secret for secret in found if len(secret) > 2}
