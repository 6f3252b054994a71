"""Whole runs, tiny: through the command line in this process, or in a process of its own that can be killed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.cli.main import run_command
from gsstream.core.changes import RowEdit, add_as_nodes, add_to_nodes
from gsstream.core.frame import Frame
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step import frame_step as step_module
from gsstream.input.recordings.open import DEMO_FOLDER

#: Six frames of an analytic scene, three training cameras, one test camera.
WORLD = "synthetic:frames=6&views=3&width=64&height=48&supersample=1"
TINY = {
    "first_frame.max_iterations": 30,
    "first_frame.max_points": 800,
    "stream.epochs": 3,
    # The analytic scenes stand before black; of so few Gaussians, a shell would be most.
    "background": [0, 0, 0],
    "first_frame.shell": False,
    # So small and so far off, the images would miss a handful of Gaussians only, too few to say anything.
    "first_frame.prune_error": 0,
}


def arguments(
    out: Path, *more: str, source: str = WORLD, method: str = "dense", pictures: bool = False, **settings: Any
) -> list[str]:
    """A ``gsstream run`` command line; settings are recipe keys with ``__`` for the dot, None: not set.

    Pictures cost time: ask.
    """
    # The analytic scene has points of its own; looking for others takes longer than the rest of frame 0.
    points = {"first_frame.points": "recording"} if source.startswith("synthetic:") else {}
    values = {**TINY, **points, **{key.replace("__", "."): value for key, value in settings.items()}}
    sets = [item for key, value in values.items() if value is not None for item in ("--set", f"{key}={value}")]
    shown = "--no-video" if pictures else "--no-pictures"
    return ["run", "--source", source, "--method", method, "--out", str(out), "--quiet", shown, *sets, *more]


def encode(out: Path, *more: str, **options: Any) -> bytes:
    """Run here, to the end; the bytes of the stream."""
    assert run_command(arguments(out, *more, **options)) == 0
    return (out / "stream.gss").read_bytes()


def finish(*command: str, **environment: str) -> tuple[int, str, str]:
    """(exit code, stdout, stderr) of ``gsstream ...`` in a process that imports everything itself."""
    code = "from gsstream.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *command],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def demo_copy(
    folder: Path, *, train: int = 3, frames: int = 3, edit: Callable[[dict[str, Any]], None] = lambda _: None
) -> Path:
    """Some training cameras, the test camera and the first frames of the demo recording, as a folder to spoil."""
    shutil.copytree(DEMO_FOLDER, folder)
    data = json.loads((folder / "cameras.json").read_text())
    kept = [c for c in data["cameras"] if c["split"] == "train"][:train]
    data["cameras"] = kept + [c for c in data["cameras"] if c["split"] == "test"]
    data["frames"] = frames
    edit(data)
    (folder / "cameras.json").write_text(json.dumps(data))
    return folder


#: Frames of the demo recording that a paused copy shows: it stands still from 1 to 3.
SHOWN = (0, 1, 1, 1, 2)


def paused(folder: Path, shown: Sequence[int] = SHOWN) -> Path:
    """A copy of the demo that shows these of its frames, image file by image file."""
    demo_copy(folder, frames=len(shown))
    for camera in (path for path in folder.iterdir() if path.is_dir()):
        originals = {i: (camera / f"{i:06d}.jpg").read_bytes() for i in set(shown)}
        for place, i in enumerate(shown):
            (camera / f"{place:06d}.jpg").write_bytes(originals[i])
    return folder


def without_test_cameras(data: dict[str, Any]) -> None:
    """An edit of cameras.json."""
    data["cameras"] = [c for c in data["cameras"] if c["split"] == "train"]
    data["test_cameras"] = []


class Witness:
    """Remembers the encoder's state after every frame of runs in this process; changes nothing."""

    def __init__(self, monkeypatch: Any) -> None:
        self.states: list[StreamState] = []
        encode = Encoder.encode

        def watched(encoder: Encoder, frame: Frame) -> Any:
            step = encode(encoder, frame)
            self.states.append(step.state)
            return step

        monkeypatch.setattr(Encoder, "encode", watched)


@contextmanager
def broken_off_in(frame: int) -> Iterator[None]:
    """Runs in this process are interrupted, as by Ctrl-C, when they are about to step to this frame."""
    encode = Encoder.encode

    def impatient(encoder: Encoder, now: Frame) -> Any:
        if now.index == frame:
            raise KeyboardInterrupt
        return encode(encoder, now)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Encoder, "encode", impatient)
        yield


def metrics(out: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl."""
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def growing(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """Every second frame splits 20 Gaussians off and removes ten."""

    def grown(parts, state, delta, work, rng):
        player = state.player
        if player.frame % 2:
            return delta
        rng = np.random.default_rng(player.frame)
        rows = np.sort(rng.choice(len(player.gaussians), 20, replace=False))
        copies = player.gaussians.rows(rows)
        copies = replace(copies, means=copies.means + rng.normal(0, 0.02, (20, 3)).astype(np.float32))
        levels = player.layout.unit_of[rows]
        if method == "dense":
            added = add_as_nodes(copies, levels, len(player.layout.node_counts))
        else:
            added = add_to_nodes(copies, player.layout.node_of[rows], levels)
        gone = np.sort(rng.choice(len(player.gaussians), 10, replace=False))
        return delta.with_row_edit(RowEdit(added, gone))

    monkeypatch.setattr(step_module, "with_growth", grown)
