"""``gsstream doctor``: what it says of a whole installation, of one without torch, and of one that cannot draw fast."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SITE = next(Path(place) for place in sys.path if Path(place).name == "site-packages")
#: Only the packages in a folder of links, whose .pth files are obeyed: what is not linked is not installed.
CODE = """
import site, sys
site.addsitedir(sys.argv.pop(1))
from gsstream.core import install_hints
if sys.argv.pop(1) == "wheels":
    install_hints.SOURCES = install_hints.Path("/nowhere")
from gsstream.cli.main import main
main(["doctor"])
"""


def doctor(
    folder: Path, without: str = "^$", *, of_wheels: bool = False, **environment: str
) -> tuple[int, dict[str, str]]:
    """Return the exit code and the lines, by their heading, where packages that match ``without`` are not installed."""
    packages = folder / "packages"
    packages.mkdir()
    for path in SITE.iterdir():
        if not re.search(without, path.name):
            (packages / path.name).symlink_to(path)
    command = [sys.executable, "-S", "-c", CODE, str(packages), "wheels" if of_wheels else "sources"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, env=os.environ | environment, cwd=folder
    )
    assert done.stderr == ""
    return done.returncode, {line[:13].rstrip(): line[14:] for line in done.stdout.splitlines()}


def test_a_whole_installation(tmp_path: Path) -> None:
    torch, native = pytest.importorskip("torch"), pytest.importorskip("gsstream_cpu_render.threads")
    code, lines = doctor(tmp_path, GSSTREAM_THREADS="3")
    assert code == 0
    assert lines["python"].endswith(sys.executable)
    assert lines["draws with"] == f"cpu, compiled for {native.instruction_set()}, 3 threads"
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU"
    assert lines["torch"].startswith(f"{torch.__version__}, {build} build, {tmp_path}/packages/torch, imported in ")
    assert lines["encodes with"] == "renderer 'cpu'"
    assert {"player", "encoder", "serve"} <= set(lines["extras"].removeprefix("present: ").split(", "))
    assert lines["self-test"].startswith("400 Gaussians written, read and drawn in ")


def test_an_installation_without_torch(tmp_path: Path) -> None:
    driver = tmp_path / "nvidia-smi"
    driver.write_text("#!/bin/sh\necho 'GPU 0: NVIDIA H100 80GB HBM3 (UUID: GPU-1-2)'\n")
    driver.chmod(0o755)
    code, lines = doctor(tmp_path, without=r"^(func|pytorch_)?torch", PATH=f"{tmp_path}:{os.environ['PATH']}")
    assert code == 0
    assert lines["GPU"] == "GPU 0: NVIDIA H100 80GB HBM3; not used: torch is missing"
    assert lines["torch"] == "not installed; only encoding needs it (extra encoder or s2gs)"
    assert lines["encodes with"] == "nothing: torch is missing"
    assert lines["draws with"].startswith("cpu, compiled")
    assert lines["extra encoder"] == "torch missing"
    assert "player" in lines["extras"].removeprefix("present: ").split(", ")
    assert lines["extra all"].endswith(" missing"), "an extra of extras"
    assert not lines["to install"].startswith("there is no NVIDIA GPU"), "the driver has found one"


def test_an_installation_without_the_compiled_renderer(tmp_path: Path) -> None:
    code, lines = doctor(tmp_path, without=r"cpu_render")
    assert code == 0
    assert lines["draws with"].startswith("numpy: no compiled renderer works here, so pictures are drawn with plain")
    assert lines["encodes with"].startswith("renderer 'reference': no fast renderer works here, so the reference")
    assert lines["extra player"] == "gsstream-cpu-render missing"


def test_a_bare_installation_says_once_how_the_rest_comes(tmp_path: Path) -> None:
    """From wheels, without torch and without a GPU: the CPU build comes first, and DIST is explained once."""
    code, lines = doctor(
        tmp_path, without=r"^(func|pytorch_)?torch|gsstream_(?!0)|kornia|scipy|matplotlib|ray|^av", of_wheels=True
    )
    assert code == 0
    said = "\n".join(lines.values())
    assert said.count("where DIST is") == said.count("pytorch.org") == 1
    assert lines["to install"].startswith("there is no NVIDIA GPU here: install the CPU build of torch first")
    assert "'gsstream[EXTRA]', where DIST is the folder of wheels" in lines["to install"]
    assert re.fullmatch(r"[\w-]+, [\w-]+, [\w-]+ and \d+ more missing", lines["extra all"])
    assert max(len(lines[name]) for name in lines if name.startswith("extra ")) < 80


@pytest.mark.parametrize(
    ("module", "heading", "words"),
    [
        ("raise OSError('libtorch: too short')", "torch", "cannot be imported: OSError: libtorch: too short"),
        ("def render_numpy(*_, near): return [[[7.0]]]", "self-test", "failed: "),
    ],
)
def test_what_is_broken_is_told(tmp_path: Path, module: str, heading: str, words: str) -> None:
    """A torch that is half there, and a renderer that draws something else."""
    broken = tmp_path / "packages-of-mine"
    broken.mkdir()
    if heading == "torch":
        (broken / "torch.py").write_text(module)
    else:
        (broken / "aaa.py").write_text(module)
        (broken / "aaa-1.dist-info").mkdir()
        (broken / "aaa-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: aaa\nVersion: 1\n")
        (broken / "aaa-1.dist-info" / "entry_points.txt").write_text("[gsstream.player]\naaa = aaa:render_numpy\n")
    code, lines = doctor(tmp_path, PYTHONPATH=str(broken))
    assert words in lines[heading]
    assert code == (heading == "self-test")
