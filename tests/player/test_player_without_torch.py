"""An edge device has no torch: the player, its command and the compiled renderer work in a process that refuses it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_player import NUMPY, make_stream

from gsstream.packet import FORMAT_VERSION
from gsstream.player.play import play

REFUSED = """
import sys

REFUSED = {"torch", "kornia", "matplotlib", "scipy", "torchvision", "pycolmap"}


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in REFUSED:
            raise ModuleNotFoundError(f"no module named {name!r}: this process refuses it", name=name)


sys.meta_path.insert(0, Refuse())
try:
    import torch
except ModuleNotFoundError:
    pass
else:
    sys.exit("the hook does not refuse anything")
"""
COMMANDS = """
from gsstream.cli.main import run_command

stream, out = sys.argv[1:]
for command in (
    ["play", stream, "--out", out + "/png", "--frames", "0:3"],
    ["play", stream, "--out", out + "/orbit", "--camera", "orbit", "--frames", "0:2"],
    ["info", stream],
    ["export", stream, "--format", "manifest", "--out", out],
    ["export", stream, "--out", out + "/ply", "--frames", "0:1"],
):
    code = run_command(command)
    if code:
        sys.exit(f"{command[0]} ended with {code}")
print(sorted(REFUSED & {name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
"""


def run_refusing(code: str, *args: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", REFUSED + code, *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def test_every_stream_command_runs_without_torch(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    done = run_refusing(COMMANDS, str(stream), str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "[]"
    play(stream, tmp_path / "here", frames=[0, 1, 2], renderer=NUMPY)
    for name in ("000000.png", "000001.png", "000002.png"):
        there, here = (np.asarray(Image.open(tmp_path / f / name), np.int16) for f in ("png", "here"))
        assert np.abs(there - here).max() <= 1  # the compiled renderer, where there is one, sums in another order
    assert len(list((tmp_path / "orbit").iterdir())) == 2
    assert (tmp_path / "ply" / "000000.ply").stat().st_size > 1000


def test_a_stream_of_networks_is_played_without_torch(tmp_path):
    """The sample with fields decodes to the very bits, and every command that shows a stream takes it."""
    sample = Path(__file__).parents[1] / "packet" / "samples" / FORMAT_VERSION
    digests = (
        "import hashlib\nfrom gsstream.player.playback import Playback\n"
        "with Playback(sys.argv[1]) as playback:\n"
        "    for _, scene in playback:\n"
        "        print(hashlib.sha256(b''.join(array.tobytes() for _, array in scene.items())).hexdigest())\n"
        "from gsstream.cli.main import run_command\n"
        "assert run_command(['info', sys.argv[1]]) == 0\n"
        "assert run_command(['export', sys.argv[1], '--out', sys.argv[2], '--frames', '0:3']) == 0\n"
    )
    done = run_refusing(digests, str(sample / "field.gss"), str(tmp_path / "ply"))
    assert done.returncode == 0, done.stderr
    expected = json.loads((sample / "expected.json").read_text())["field"]
    assert done.stdout.splitlines()[: len(expected)] == expected
    assert "field" in done.stdout
    assert len(list((tmp_path / "ply").iterdir())) == 3


@pytest.mark.skipif(importlib.util.find_spec("gsstream_cpu_render") is None, reason="gsstream-cpu-render is missing")
def test_the_compiled_renderer_is_the_one_found_without_torch():
    code = "from gsstream.player.render import find_renderer\nprint(find_renderer().name)"
    done = run_refusing(code)
    assert (done.returncode, done.stdout.strip()) == (0, "cpu"), done.stderr
