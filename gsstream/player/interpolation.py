"""Scenes between two frames: moved Gaussians are on their way, by the displacement in packets; others wait."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsstream.core.changes.rows import gather_rows
from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import PlayerState
from gsstream.player.playback import Playback


def interpolate(before: PlayerState, after: PlayerState, share: float) -> Gaussians[FloatArray]:
    """Return the scene at a moment between two frames that follow each other.

    The rows that the later frame displaced have gone and turned ``share`` of their way, at constant speed. Colours,
    sizes, added and removed Gaussians wait for their frame; so does everything before a key packet, which carries no
    motion.
    """
    scene, displacement = before.gaussians, after.scene.displacement
    if share == 0 or displacement is None or after.frame != before.frame + 1:
        return scene
    rows, translation, rotation = displacement.rows, displacement.translation, displacement.rotation
    if after.delta is not None and after.delta.has_row_edit:
        source = gather_rows(before.layout.node_of, after.delta.added, after.delta.removed)[rows]
        known = source < len(scene)
        rows, translation, rotation = source[known], translation[known], rotation[known]
    means, quats = scene.means.copy(), scene.quats.copy()
    means[rows] += np.float32(share) * translation
    quats[rows] = _rotated(quats[rows], rotation, share)
    return replace(scene, means=means, quats=quats)


class Moments:
    """Scenes of a stream at times in frames, whole or not; whole ones are the decoded scenes themselves.

    Times are asked for in ascending order where that is possible: going back decodes from a key packet again.
    """

    def __init__(self, playback: Playback) -> None:
        self._playback = playback
        self._before: PlayerState | None = None
        self._after: PlayerState | None = None

    @property
    def background(self) -> tuple[float, float, float]:
        """What is behind the scene that was asked for last; colours between two frames are those of the first."""
        assert self._before is not None, "no scene was asked for"
        return self._before.meta.background

    def at(self, time: float) -> Gaussians[FloatArray]:
        """Return the scene at a time, in frames; after the last frame, that of the last.

        Raises InputError outside the stream, PacketError when a packet on the way is damaged.
        """
        frame, share = int(np.floor(time)), float(time - np.floor(time))
        if self._before is None or self._before.frame != frame:
            follows = self._after is not None and self._after.frame == frame
            self._before = self._after if follows else self._playback.player_state(frame)
            self._after = None
        assert self._before is not None
        if share == 0 or frame + 1 not in self._playback.frames:
            return self._before.gaussians
        if self._after is None:
            self._after = self._playback.player_state(frame + 1)
        return interpolate(self._before, self._after, share)


def frame_times(frames: Sequence[int], recorded: float, wanted: float) -> list[float]:
    """Return the times, in frames, of pictures at another rate than the recording's, from the first to the last frame.

    Raises InputError for another rate, and for frames that do not follow each other.
    """
    if not 1 <= wanted <= 1000:
        raise InputError(f"pictures per second: expected 1 to 1000, got {wanted:g}")
    if list(frames) != list(range(frames[0], frames[0] + len(frames))):
        raise InputError("frames between frames: expected frames that follow each other; leave out fps or frames")
    step = recorded / wanted
    count = int(np.floor((frames[-1] - frames[0]) / step + 1e-6)) + 1
    times = frames[0] + np.arange(count) * step
    # A time within rounding of a frame is that frame: its scene is the decoded one, bit for bit.
    whole = np.abs(times - times.round()) < 1e-6
    return [float(time) for time in np.where(whole, times.round(), times)]


def _rotated(quats: FloatArray, rotation: FloatArray, share: float) -> FloatArray:
    """Quaternions [A, 4] turned by a share of a rotation [A, 3] given as axis * tan(angle / 2); lengths stay."""
    tangent = np.linalg.norm(rotation.astype(np.float64), axis=1)
    part = np.tan(share * np.arctan(tangent))
    x, y, z = (rotation * np.divide(part, tangent, out=np.zeros_like(part), where=tangent > 0)[:, None]).T
    w1, x1, y1, z1 = quats.astype(np.float64).T
    product = np.stack(
        [
            w1 - x * x1 - y * y1 - z * z1,
            x1 + x * w1 + y * z1 - z * y1,
            y1 - x * z1 + y * w1 + z * x1,
            z1 + x * y1 - y * x1 + z * w1,
        ],
        1,
    )
    turned: FloatArray = (product / np.sqrt(1 + part * part)[:, None]).astype(np.float32)
    return turned
