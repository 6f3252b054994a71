"""What the system refuses ends every command in one sentence: no room for the output, a name too long, no memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gsstream.cli.main import run_command
from gsstream.player import playback

LONG = "x" * 300
SAMPLE = Path(__file__).parents[1] / "packet/samples/2.0/moving.gss"
#: Every place of the command line that takes a name of a file or folder.
DOORS = {
    "info": ["info", LONG],
    "play": ["play", LONG, "--out", "o"],
    "play --out": ["play", "s.gss", "--out", LONG],
    "play --camera": ["play", "s.gss", "--camera", f"{LONG}.json", "--out", "o"],
    "export": ["export", LONG, "--out", "o"],
    "export --out": ["export", "s.gss", "--out", LONG],
    "export --format page": ["export", "s.gss", "--format", "page", "--out", LONG],
    "export --rendition": ["export", "s.gss", "--format", "page", "--rendition", LONG, "--out", "o"],
    "evaluate": ["evaluate", LONG],
    "evaluate --source": ["evaluate", "s.gss", "--source", LONG],
    "evaluate --ply-sequence": ["evaluate-files", "--ply-sequence", LONG, "--source", "demo"],
    "evaluate --renders": ["evaluate-files", "--renders", LONG, "--source", "demo"],
    "evaluate --lpips-onnx": ["evaluate", "s.gss", "--lpips-onnx", LONG],
    "open": ["open", LONG],
    "run --out": ["run", "--source", "demo", "--quiet", "--out", LONG],
    "run --first-frame": ["run", "--source", "demo", "--quiet", "--first-frame", LONG, "--out", "o"],
    "run --recipe": ["run", "--source", "demo", "--quiet", "--recipe", LONG, "--out", "o"],
    "run --source": ["run", "--source", LONG, "--quiet", "--out", "o"],
    "run --source watch:": ["run", "--source", f"watch:{LONG}?timeout=0.1", "--quiet", "--out", "o"],
    "scene validate": ["scene", "validate", LONG],
    "recipe --recipe": ["recipe", "dense", "--recipe", LONG],
    "new-plugin": ["new-plugin", LONG],
}


@pytest.mark.parametrize("door", DOORS)
def test_a_name_too_long_is_one_sentence(
    door: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s.gss").write_bytes(SAMPLE.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert run_command(DOORS[door]) in (1, 2)
    said = capsys.readouterr()  # findings of a recording are what its command prints
    told = [line for line in (said.err + said.out).splitlines() if not line.startswith(("note: ", "warning: "))]
    assert len([line for line in told if "rror: " in line]) == 1, told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.gss"]


@pytest.mark.parametrize("command", [["--help"], ["methods"], ["info", "s.gss"], ["recipe", "dense"], ["--version"]])
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_output_is_one_sentence(command: list[str], tmp_path: Path) -> None:
    (tmp_path / "s.gss").write_bytes(SAMPLE.read_bytes())
    with Path("/dev/full").open("w") as full:
        code = "from gsstream.cli.main import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", code, *command], stdout=full, stderr=subprocess.PIPE, cwd=tmp_path, check=False
        )
    assert done.returncode == 1
    assert done.stderr == b"error: cannot write the output: No space left on device; make room\n"


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: 1 GB")])
def test_no_memory_is_one_sentence(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(playback, "decode_packet", fails)
    for command in ("play", "export"):
        assert run_command([command, str(SAMPLE), "--out", str(tmp_path / "o")]) == 1
        said = capsys.readouterr().err.splitlines()
        assert said[-1].startswith("error: this takes more memory than the system gives; "), said
        assert not [line for line in said if "Traceback" in line]


def test_another_error_of_a_program_stays_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(playback, "decode_packet", fails)
    with pytest.raises(RuntimeError, match="a defect"):
        run_command(["play", str(SAMPLE), "--out", "o"])
