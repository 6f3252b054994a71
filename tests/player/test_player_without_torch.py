"""An edge device has no torch: the player, its command and the compiled renderer work in a process that refuses it."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from test_player import NUMPY, make_stream

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
    ["manifest", stream, "--out", out + "/s.json"],
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


@pytest.mark.skipif(importlib.util.find_spec("gsstream_cpu_render") is None, reason="gsstream-cpu-render is missing")
def test_the_compiled_renderer_is_the_one_found_without_torch():
    code = "from gsstream.player.render import find_renderer\nprint(find_renderer().name)"
    done = run_refusing(code)
    assert (done.returncode, done.stdout.strip()) == (0, "cpu"), done.stderr
