"""The page about one's own recording works after ``pip install``, without the repository."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.input.recordings import tiny_recordings

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "howto" / "your-data.md"
#: What stands in the first column of a row -> who writes such a folder. The demo stands for ``cameras.json``.
WRITERS: dict[str, Callable[..., Path]] = {
    "N3DV": lambda folder, world: tiny_recordings.write_n3dv(folder, world, style="folders"),
    "ENeRF": tiny_recordings.write_enerf,
    "PanopticSports": lambda folder, world: panoptic(folder, world),
    "COLMAP": lambda folder, world: tiny_recordings.write_colmap(folder, world, binary=False, frames="folders"),
    "nerfstudio": tiny_recordings.write_nerfstudio,
}
#: The smallest run, and points of frame 0 without pycolmap, as the page says.
SMALL = ["--frames", "1", "--set", "first_frame.max_iterations=2", "--set", "first_frame.points=auto", "--no-pictures"]
#: Runs commands and prints what came: one process, because torch is imported once for all.
CODE = """
import contextlib, io, json, sys
import gsstream
from gsstream.cli.main import run_command
found = [gsstream.__file__]
for command in json.loads(sys.argv[1]):
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        code = run_command(command)
    found.append([code, said.getvalue()])
print(json.dumps(found))
"""


def panoptic(folder: Path, world: tiny_recordings.World) -> Path:
    """Write a recording whose cameras have some of the numbers of the data set."""
    file = tiny_recordings.write_panoptic(folder, world) / "train_meta.json"
    numbers = {1: 10, 2: 15, 3: 30}
    meta = json.loads(file.read_text(encoding="utf-8"))
    meta["cam_id"] = [[numbers.get(number, number) for number in row] for row in meta["cam_id"]]
    file.write_text(json.dumps(meta), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the wheel of gsstream, installed; its dependencies are those of this environment."""
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    wheels, target = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("installed")
    options = ["-t", "wheel", "-d", str(wheels)]
    subprocess.run([sys.executable, "-m", "hatchling", "build", *options], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = wheels.glob("*.whl")
    options = ["--quiet", "--no-deps", "--no-index", "--target", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True, capture_output=True)
    return target


def commands_of_the_page() -> dict[str, list[str]]:
    """What a row is about -> its command, without the word gsstream."""
    table = PAGE.read_text(encoding="utf-8").split("| you have | command |\n")[1].split("\n\n")[0]
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()[1:]]
    return {what: shlex.split(re.findall(r"`gsstream ([^`]+)`", command)[0]) for what, command in rows}


@pytest.mark.slow
def test_the_commands_of_the_page_run(installed: Path, tmp_path: Path) -> None:
    world, calls = tiny_recordings.make_world(views=5, frames=2), []
    for what, command in commands_of_the_page().items():
        name = next((name for name in WRITERS if name in what), None)
        if name is not None:
            folder = WRITERS[name](tmp_path / name, world)
        elif "cameras.json" in what:
            folder = ROOT / "gsstream" / "input" / "recordings" / "demo" / "pickblocks_tiny_160"
        else:  # videos, which need PyAV; a folder that is still being written
            assert "Meet Room" in what or "still being written" in what, f"no folder is written for the row {what!r}"
            continue
        words = [{"DIR": str(folder), "OUT": f"out-{len(calls)}"}.get(word, word) for word in command]
        calls.append([*words, *SMALL])
    assert len(calls) == len(WRITERS) + 1
    calls.append(["evaluate", "out-0", "--protocol", "n3dv"])
    calls.append(["run", "--source", "demo", "--out", "x", "--recipe", "configs/recordings/n3dv.yaml"])
    environment = {**os.environ, "PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CODE, json.dumps(calls)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    place, *found = json.loads(done.stdout.splitlines()[-1])
    assert Path(place).is_relative_to(installed)
    for call, (code, said) in zip(calls[:-2], found[:-2], strict=True):
        assert code == 0, f"gsstream {shlex.join(call)}: {said}"
    assert found[-2][0] == 2
    assert "run with --recipe recording:n3dv" in found[-2][1], "the tiny pictures are not those of the protocol"
    assert found[-1][0] == 2
    assert "--recipe recording:n3dv" in found[-1][1]
