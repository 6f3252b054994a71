"""A capture process: copies a finished recording frame by frame into a folder that somebody may be watching.

``python capture.py FINISHED FOLDER FPS [OPTIONS AS JSON]``; options: slow: seconds between the halves of each file
(written in place); half: [camera, frame] after whose first half the process kills itself; late: [camera, frame,
seconds]; absent: [camera, frame]; sentinel: write END at last (default true).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from itertools import product
from pathlib import Path


def put(source: Path, target: Path, slow: float, die: bool) -> None:
    """One file: renamed into place, or written in two halves in place."""
    data = source.read_bytes()
    if not slow and not die:
        part = target.with_suffix(".part")
        part.write_bytes(data)
        part.replace(target)
        return
    with target.open("wb") as file:
        file.write(data[: len(data) // 2])
        file.flush()
        if die:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(slow)
        file.write(data[len(data) // 2 :])


def main(finished: Path, folder: Path, fps: float, options: dict) -> None:
    """Write all frames, camera by camera, at most ``fps`` per second."""
    data = json.loads((finished / "cameras.json").read_text())
    later: list[threading.Thread] = []
    for t in range(data["frames"]):
        time.sleep(1 / fps)
        for camera in data["cameras"]:
            name, relative = camera["id"], camera["frames"] % t
            (folder / relative).parent.mkdir(parents=True, exist_ok=True)
            job = (finished / relative, folder / relative, options.get("slow", 0), [name, t] == options.get("half"))
            if [name, t] == options.get("absent"):
                continue
            if [name, t] == options.get("late", [])[:2]:
                later.append(threading.Timer(options["late"][2], put, job))
                later[-1].start()
                continue
            put(*job)
    for thread in later:
        thread.join()
    if options.get("sentinel", True):
        (folder / "END").touch()


def begin(finished: Path, folder: Path) -> None:
    """The folder as it is before the first frame: calibration without a number of frames, and points."""
    folder.mkdir()
    data = json.loads((finished / "cameras.json").read_text())
    del data["frames"]
    (folder / "cameras.json").write_text(json.dumps(data))
    shutil.copy(finished / "points_frame0.npz", folder)


def come(finished: Path, folder: Path, *frames: int) -> None:
    """Every camera's image of these frames, renamed into place; all are there once the first is."""
    for frame, camera in product(reversed(frames), json.loads((folder / "cameras.json").read_text())["cameras"]):
        target = folder / (camera["frames"] % frame)
        target.parent.mkdir(exist_ok=True)
        put(finished / (camera["frames"] % frame), target, slow=0, die=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), json.loads((sys.argv[4:] or ["{}"])[0]))
