"""Raw recordings: the clips of a folder without a calibration, or those that a reader of a layout found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsstream.core.errors import ShapeError, SourceError
from gsstream.core.names import check_camera_ids
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import unpacked
from gsstream.input.recordings.clips import IMAGE_SUFFIXES, VIDEO_SUFFIXES, Clip, ImageClip, clips_in
from gsstream.input.recordings.images import told_apart
from gsstream.input.recordings.sync import align


@dataclass(frozen=True, slots=True)
class RawCamera:
    """One camera: its ``clip``, of which the pictures of ``span`` are taken."""

    name: str  # its id
    clip: Clip
    span: range

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of its pictures."""
        return self.clip.size

    @property
    def files(self) -> tuple[Path, ...]:
        """Its pictures in order, where a scene may hold them as they are; else none."""
        files = self.clip.files[self.span.start : self.span.stop] if isinstance(self.clip, ImageClip) else ()
        return files if {path.suffix.lower() for path in files} in ({".png"}, {".jpg"}) else ()

    def frames(self, most: int | None) -> Iterator[FloatArray]:
        """Read the first ``most`` pictures [H, W, 3] in [0, 1]. Raises SourceError for one that cannot be read."""
        try:
            for index in self.span[:most]:
                yield unpacked(self.clip.read(index, self.size))
        finally:
            self.clip.close()


def find_cameras(folder: Path) -> tuple[list[RawCamera], float | None]:
    """Return the cameras of a raw recording, in order of their names, and the rate of its videos, if any.

    Recognised: one folder of pictures per camera; one video per camera; one picture per camera. Raises SourceError for
    anything else, for fewer than two cameras, and for what a run refuses: gaps, different rates, damaged files.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected a raw recording")
    clips = clips_in([folder, folder / "videos", folder / "images"])
    if not clips:
        photographs = [*folder.glob("*.[hH][eE][iI][cCfF]"), *folder.glob("*/*.[hH][eE][iI][cCfF]")]
        if photographs:
            raise SourceError(f"{photographs[0]} and {len(photographs) - 1} more: {told_apart(photographs[0])}")
        raise SourceError(
            f"{folder}: expected at least two cameras: a folder of pictures per camera, a video per camera, or a "
            f"picture per camera ({', '.join(IMAGE_SUFFIXES + VIDEO_SUFFIXES)})"
        )
    try:
        check_camera_ids(clips)
    except ShapeError as error:
        raise SourceError(f"{folder}: {error}") from error
    return beside_each_other(folder.resolve().name, clips)


def beside_each_other(title: str, clips: Mapping[str, Clip]) -> tuple[list[RawCamera], float | None]:
    """Return cameras that show the same instants, as a run lays them, and the rate of the videos, if any."""
    beside = align(title, clips)
    cameras = [
        RawCamera(name, clip, range(beside.skip[name], beside.skip[name] + beside.num_frames))
        for name, clip in clips.items()
    ]
    return cameras, beside.fps


def first_frames(cameras: list[RawCamera]) -> list[FloatArray]:
    """Return frame 0 of every camera."""
    return [next(camera.frames(1)) for camera in cameras]


def changes_of(cameras: Sequence[RawCamera], resampled: Sequence[bool], target: tuple[int, int]) -> list[str]:
    """Return, in sentences, what becomes of the pictures of these cameras in a scene of ``target`` (width, height).

    A rig has one size, for renderers draw all cameras of a batch at once: the smallest camera decides.
    """
    messages = []
    if len({camera.size for camera in cameras}) > 1:
        sizes = ", ".join(f"{c.name} {c.size[0]} x {c.size[1]}" for c in cameras if c.size != target)
        least = [min(camera.size[axis] for camera in cameras) for axis in (0, 1)]
        small = " ".join(f"--without {c.name}" for c in cameras if c.size[0] == least[0] or c.size[1] == least[1])
        messages.append(
            f"warning: all pictures become {target[0]} x {target[1]} pixels, since a rig has one size; shrunk or cut "
            f"are {sizes}; to keep more pixels, leave out the smallest: {small}"
        )
    deep = [c.name for c, made in zip(cameras, resampled, strict=True) if c.clip.deep and (made or not c.files)]
    if deep:
        messages.append(f"pictures of {', '.join(deep)} have more than 8 bits per channel; they are written with 8")
    return messages
