"""The motions of a delta packet (section motion): moving groups coded as runs, their corrections as symbols."""

from __future__ import annotations

import math
import struct

import numpy as np

from gsstream.core.changes import Groups, Motion, Scene, apply_motion, groups_for
from gsstream.core.changes.motion import MAX_BRIGHTNESS_BINS
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet.base import Section, add_offset
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.symbols import decode_symbols, encode_symbols

_MOTION = struct.Struct("<BBfff")
_PREDICTED, _REGROUP = 1, 2
#: Most motions of one frame: the levels of a hierarchy of groups.
MAX_MOTIONS = 8
#: Corrections beyond this are refused: they could not be added to a float32 scene.
_MAX_TRANSLATION = 1e18


def encode_motions(motions: tuple[Motion, ...]) -> list[tuple[str, bytes]]:
    """Return the section that holds the motions of a frame; none without any. Raises ShapeError for a bad one."""
    if not motions:
        return []
    if len(motions) > MAX_MOTIONS:
        raise ShapeError(f"delta: expected at most {MAX_MOTIONS} motions in one frame, got {len(motions)}")
    return [("motion", bytes([len(motions)]) + pack_blobs([_encode(motion) for motion in motions]))]


def decode_motions(section: Section, scene: Scene) -> tuple[Motion, ...]:
    """Return the motions of a frame. Their groups depend on the scene, which each of them moves. Raises PacketError."""
    with add_offset(section.offset):
        number = section.data[0] if section.data else 0
        if not 1 <= number <= MAX_MOTIONS:
            raise PacketError(f"motion: expected 1 to {MAX_MOTIONS} motions, got {number}")
        motions = []
        for blob in unpack_blobs(section.data[1:], number):
            motion = _decode(blob, scene)
            motions.append(motion)
            if len(motions) < number:
                try:
                    scene = apply_motion(scene, motion)[0]
                except ShapeError as error:
                    raise PacketError(str(error)) from error
    return tuple(motions)


def _encode(motion: Motion) -> bytes:
    problem = _misfit(motion)
    moving = np.asarray(motion.moving)
    if problem is None and (moving.ndim != 1 or motion.symbols.shape != (int(np.count_nonzero(moving)), 6)):
        problem = f"symbols: expected [{int(np.count_nonzero(moving))}, 6], got {list(motion.symbols.shape)}"
    if problem is None and motion.symbols.dtype != np.int32:
        problem = f"symbols: expected int32, got {motion.symbols.dtype}"
    problem = problem or _exceeds_range(motion)
    if problem:
        raise ShapeError(f"motion: {problem}")
    flags = _PREDICTED * motion.predicted | _REGROUP * motion.regroup
    head = _MOTION.pack(flags, motion.brightness_bins, motion.cell, motion.translation_step, motion.rotation_step)
    return head + pack_blobs([encode_gates(moving.astype(np.uint8), 1), encode_symbols(motion.symbols)])


def _decode(data: bytes, scene: Scene) -> Motion:
    if len(data) < _MOTION.size:
        raise PacketError("motion cut short")
    flags, bins, cell, translation_step, rotation_step = _MOTION.unpack_from(data)
    if flags & ~(_PREDICTED | _REGROUP):
        raise PacketError(f"motion: unknown flags {flags}; upgrade gsstream")
    none = Motion(
        cell=cell,
        brightness_bins=bins,
        moving=np.zeros(0, np.uint8),
        symbols=np.zeros((0, 6), np.int32),
        translation_step=translation_step,
        rotation_step=rotation_step,
    )
    problem = _misfit(none)
    if problem:
        raise PacketError(f"motion: {problem}")
    regroup = bool(flags & _REGROUP)
    groups: Groups = groups_for(scene, cell, bins, regroup)
    marks, table = unpack_blobs(data[_MOTION.size :], 2)
    moving, levels = decode_gates(marks, groups.count)
    if levels != 1:
        raise PacketError("motion: groups move or stand still, there are no levels")
    symbols = decode_symbols(table, int(np.count_nonzero(moving)), 6)
    motion = Motion(
        cell=cell,
        brightness_bins=bins,
        moving=moving,
        symbols=symbols,
        translation_step=translation_step,
        rotation_step=rotation_step,
        predicted=bool(flags & _PREDICTED),
        regroup=regroup,
    )
    problem = _exceeds_range(motion)
    if problem:
        raise PacketError(f"motion: {problem}")
    return motion


def _misfit(motion: Motion) -> str | None:
    """Why a motion cannot be; None when its settings can."""
    for name in ("cell", "translation_step", "rotation_step"):
        value = float(getattr(motion, name))
        if not 0 < value < 1e9 or value != float(np.float32(value)):
            return f"{name}: expected a float32 above 0 and below 1e9, got {value!r}"
    if not 1 <= motion.brightness_bins <= MAX_BRIGHTNESS_BINS or not math.isfinite(motion.cell):
        return f"brightness_bins: expected 1 to {MAX_BRIGHTNESS_BINS}, got {motion.brightness_bins}"
    return None


def _exceeds_range(motion: Motion) -> str | None:
    """Why the corrections of a motion cannot be; None when they can."""
    if motion.symbols.size == 0:
        return None
    sizes = np.abs(motion.symbols.astype(np.float64)).max(0)
    largest = max(float(sizes[:3].max()) * motion.translation_step, float(sizes[3:].max()) * motion.rotation_step)
    return (
        f"a correction of {largest:g} cannot be, expected at most {_MAX_TRANSLATION:g}"
        if largest > _MAX_TRANSLATION
        else None
    )
