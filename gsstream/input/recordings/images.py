"""Decode one photograph and shrink it: exact area averaging in floating point, so no extra rounding to 8 bits."""

from __future__ import annotations

import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.core.errors import InputError, SourceError
from gsstream.core.memory import require_memory
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import unpacked

#: Bytes at the peak for every pixel of a file, and of one that is averaged down unevenly, measured.
PER_PIXEL, PER_AVERAGED = 20, 48
#: Columns or rows that are averaged at a time: so few stay in a processor's cache.
_LINES = 32
#: A file that unpacks to more bytes than this, and to more than this many times its own size, is no recording.
_UNPACKED, _PACKED = 1 << 26, 100
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_RGB_COLOR_TYPE = b"\x02"
#: The only decoders that Pillow may try: others are many, some start programs (EPS: Ghostscript), none is documented.
PICTURE_FORMATS = ("PNG", "JPEG")
#: What Pillow raises for damaged files; ValueError: texts and profiles that unpack to more than a megabyte.
UNDECODABLE = (OSError, SyntaxError, ValueError, EOFError, zlib.error, Image.DecompressionBombError)
#: The EXIF tag that says how viewers turn a picture, and its value for "not at all".
_ORIENTATION, _UPRIGHT = 0x0112, 1
_READABLE = "8-bit JPEG or PNG, or 16-bit PNG, without transparency"


def told_apart(path: Path) -> str:
    """Return the cure for a file that no decoder reads; formats of phones are known by their first bytes."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return f"it is {head[8:12].decode('ascii', 'replace').upper()}, as phones write it: convert it to JPEG or PNG"
    return "it is probably truncated or not an image: copy or export it again"


def read_image(
    path: Path, size: tuple[int, int], target: tuple[int, int], declared: str = "cameras.json declares"
) -> FloatArray:
    """Decode an image, average it down, and return [h, w, 3] float32 in [0, 1]. Raises SourceError naming the file."""
    return unpacked(read_stored(path, size, target, declared))


def read_stored(
    path: Path, size: tuple[int, int], target: tuple[int, int], declared: str = "cameras.json declares"
) -> Any:
    """Return what :func:`read_image` does as uint8, of which 255 is 1.0, where that holds it: 8 bits at their size."""
    even = size[0] % target[0] == 0 and size[0] // target[0] == size[1] / target[1]
    pixels, full_scale = _decode(path, size, declared, PER_PIXEL if even else PER_AVERAGED)
    if pixels.dtype == np.uint8 and target == size:
        return pixels
    return shrink(pixels, target) / np.float32(full_scale)


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return (width, height) after scaling by a factor in (0, 1], rounded to whole pixels, at least one."""
    if not 0 < scale <= 1:
        raise SourceError(f"scale: expected a factor in (0, 1], got {scale!r}; recordings are never enlarged")
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def shrink(pixels: np.ndarray[Any, Any], target: tuple[int, int]) -> FloatArray:
    """Average [H, W, 3] pixels down to ``target`` (width, height), at most the present size; float32, same unit."""
    height, width = pixels.shape[:2]
    ratio_x, ratio_y = width / target[0], height / target[1]
    if ratio_x == 1 and ratio_y == 1:
        return pixels.astype(np.float32)
    if ratio_x == ratio_y == int(ratio_x):
        step = int(ratio_x)
        total = np.zeros((target[1], target[0], 3), np.uint32 if pixels.dtype.kind == "u" else np.float64)
        for y in range(step):
            for x in range(step):
                total += pixels[y::step, x::step]
        return total.astype(np.float32) / np.float32(step * step)
    lines, out = np.empty((target[1], width * 3)), np.empty((target[1], target[0], 3), np.float32)
    columns = pixels.reshape(height, -1)
    for at in (slice(first, first + _LINES) for first in range(0, width * 3, _LINES)):
        lines[:, at] = _average(columns[:, at], target[1])
    for at in (slice(first, first + _LINES) for first in range(0, target[1], _LINES)):
        rows = lines[at].reshape(-1, width, 3).transpose(1, 0, 2)
        out[at] = _average(rows.reshape(width, -1), target[0]).reshape(target[0], -1, 3).transpose(1, 0, 2)
    return out


def _average(lines: np.ndarray[Any, Any], target: int) -> FloatArray:
    """Area-average [n, m] along the first axis to [target, m]: differences of the running sum at the new edges."""
    count = len(lines)
    total = np.zeros((count + 1, lines.shape[1]))
    np.cumsum(lines, axis=0, out=total[1:])
    edges = np.arange(target + 1) * (count / target)
    below = np.minimum(edges.astype(np.int64), count - 1)
    at_edges = total[below] + (edges - below)[:, None] * lines[below]
    means: FloatArray = np.diff(at_edges, axis=0) * (target / count)
    return means


def check_unpacked(path: Path, size: int, message: str) -> None:
    """Raise SourceError for a file that unpacks to far more bytes than it has: ask before unpacking it."""
    packed = path.stat().st_size
    if size > max(_UNPACKED, _PACKED * packed):
        raise SourceError(f"{path}: {packed} bytes unpack to {size}, more than {_PACKED} times as many: {message}")


def check_photograph(path: Path, image: Image.Image) -> None:
    """Raise SourceError for a picture of very many pixels in a file of very few bytes, by its header alone."""
    size = image.width * image.height * (6 if is_deep(path) else 3)
    check_unpacked(path, size, "this is no photograph; export it again")


def is_deep(path: Path) -> bool:
    """Say whether an image file holds 16 bits per channel: a PNG may; all others that we read hold 8."""
    head = _head(path)
    return head.startswith(_PNG_SIGNATURE) and head[24:25] == b"\x10"


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(26)


def _decode(path: Path, size: tuple[int, int], declared: str, per_pixel: int) -> tuple[np.ndarray[Any, Any], float]:
    """Pixels [H, W, 3] uint8 or uint16 and the value that means 1.0; none are decoded of a picture of another size."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as image:
            if image.size != size:
                raise SourceError(
                    f"{path}: the image is {image.width} x {image.height} pixels, but {declared} {size[0]} x {size[1]};"
                    " correct the declared size (and K with it) or export the frames again"
                )
            check_photograph(path, image)
            require_memory(image.width * image.height * per_pixel, f"the picture {path}")
            if is_deep(path) and _head(path)[25:] == _RGB_COLOR_TYPE:
                return _decode_rgb16(path), 65535.0
            image.load()
            _warn_if_rotated(image)
            return _to_rgb(path, image)
    except FileNotFoundError as error:
        raise SourceError(f"{path}: the image is missing; every declared frame must exist ({_READABLE})") from error
    except InputError:  # is a ValueError, too
        raise
    except UNDECODABLE as error:
        raise SourceError(
            f"{path}: the image cannot be decoded ({error}); expected {_READABLE}; {told_apart(path)}"
        ) from error


def _warn_if_rotated(image: Image.Image) -> None:
    """Warn, once for a recording, of pictures that viewers turn and this reader does not: the poses decide."""
    turned = image.getexif().get(_ORIENTATION, _UPRIGHT) if "exif" in image.info else _UPRIGHT
    if turned != _UPRIGHT:
        warnings.warn(
            f"pictures of this recording ask viewers to turn them (EXIF orientation {turned}); their pixels are used "
            "as they are stored, as COLMAP does. If the calibration was made of turned pictures, turn the files too",
            stacklevel=2,
        )


def _decode_rgb16(path: Path) -> np.ndarray[Any, Any]:
    # Pillow keeps only the high byte of 16-bit colour PNG; kornia's decoder keeps both.
    from kornia_rs import io

    try:
        return np.asarray(io.read_image_png_u16(str(path), "rgb"))
    except Exception as error:  # the decoder raises bare Exception for every damaged file
        raise OSError(str(error)) from error


def _to_rgb(path: Path, image: Image.Image) -> tuple[np.ndarray[Any, Any], float]:
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info:
        if is_deep(path) or image.convert("RGBA").getchannel("A").getextrema() != (255, 255):
            raise SourceError(
                f"{path}: the image has a transparency channel (mode {image.mode}); expected {_READABLE}. "
                "Flatten it over the background you want to train against"
            )
        warnings.warn(
            "pictures of this recording have a transparency channel; as long as it is opaque everywhere, only the "
            "colours are read",
            stacklevel=2,
        )
        return np.asarray(image.convert("RGBA"))[..., :3].copy(), 255.0
    if image.mode.startswith("I;16"):
        grey = np.asarray(image).astype(np.uint16)
        return np.repeat(grey[..., None], 3, axis=2), 65535.0
    if image.mode not in ("RGB", "L", "P", "1"):
        raise SourceError(f"{path}: unsupported pixel layout {image.mode!r}; expected {_READABLE}")
    return np.asarray(image.convert("RGB")), 255.0
