"""The folder that ``gsstream run --source watch:DIR?ready=rename`` follows: cameras.json, pictures by rename, END."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsstream.core.errors import OutputError
from gsstream.input.recordings.calibration import CALIBRATION_FILE, SCHEMA
from gsstream_capture.pictures import CameraPlan

#: Free bytes of the disk below which instants are dropped, and below which the capture ends.
LOW, FULL = 1_000_000_000, 100_000_000
LOG, END = "capture.jsonl", "END"


class FolderWriter:
    """Writes instants; a picture is there whole or not at all. Raises OutputError for a folder that holds something.

    ``more``: what cameras.json says besides; None: pictures as they came, without a cameras.json.
    """

    def __init__(self, out: Path, plans: Sequence[CameraPlan], fps: float, *, more: Mapping[str, Any] | None) -> None:
        self._out, self._plans, self.frames = out, plans, 0
        claim(out)
        for plan in plans:
            (out / plan.name).mkdir()
        if more is not None:
            self._describe({"schema": SCHEMA, "fps": fps, **more})
        self._log = (out / LOG).open("a", encoding="utf-8")

    def _describe(self, data: dict[str, Any]) -> None:
        cameras = [
            {
                "id": plan.name,
                "width": plan.size[0],
                "height": plan.size[1],
                "K": plan.K.tolist(),
                "w2c": plan.w2c.tolist(),
                "frames": f"{plan.name}/%06d.jpg",
                "split": plan.split,
                **({} if plan.gain is None else {"gain": [round(part, 5) for part in reversed(plan.gain)]}),
            }
            for plan in self._plans
        ]
        self._put(self._out / CALIBRATION_FILE, json.dumps({**data, "cameras": cameras}, indent=1).encode())

    @property
    def free(self) -> int:
        """Bytes that the disk has left."""
        return shutil.disk_usage(self._out).free

    def add(self, pictures: Mapping[int, bytes], facts: Mapping[str, Any]) -> None:
        """Write one instant: files by camera, and its line of the log.

        They get their names when all are written: who follows takes a camera that is behind the others for gone.
        """
        paths = {
            self._out / self._plans[number].name / f"{self.frames:06d}.jpg": pictures[number] for number in pictures
        }
        parts = [self._part(path, data) for path, data in paths.items()]
        for part, path in zip(parts, paths, strict=True):
            self._named(part, path)
        self._log.write(json.dumps({"frame": self.frames, **facts}) + "\n")
        self._log.flush()
        self.frames += 1

    def end(self) -> None:
        """Say that nothing more will come."""
        self._log.close()
        (self._out / END).touch()

    def _put(self, path: Path, data: bytes) -> None:
        self._named(self._part(path, data), path)

    def _part(self, path: Path, data: bytes) -> Path:
        part = path.with_name(f"{path.name}.part")
        with _told(path):
            part.write_bytes(data)
        return part

    def _named(self, part: Path, path: Path) -> None:
        with _told(path):
            part.replace(path)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


def claim(out: Path) -> None:
    """Make an empty folder, or take one. Raises OutputError where it holds something or cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty; expected a new folder, choose another --out")
    except OSError as error:
        raise OutputError(f"the folder {out} cannot be used: {error.strerror or error}") from error
