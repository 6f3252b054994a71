"""The failure drill: a plugin that fails in each of the six rings costs neither the CLI, nor others, nor the stream.

Every case is a real distribution and the real command line in a process of its own. docs/plugin-failures.md shows the
same rings to users, with the messages that are demanded here.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gsstream.player.playback import Playback

BROKEN = Path(__file__).parent / "broken"
PAGE = Path(__file__).parents[2] / "docs" / "plugin-failures.md"
RUN = [
    "run", "--source", "synthetic:frames=5&views=2&width=32&height=24&supersample=1", "--quiet", "--no-pictures",
    "--set", "renderer=reference", "--set", "first_frame.max_iterations=3",
    "--set", "first_frame.max_points=60", "--set", "stream.epochs=1",
    "--set", "first_frame.prune_error=0", "--set", "first_frame.shell=false",
]  # fmt: skip


@pytest.fixture
def drill(lab):
    package = lab.folder / "gsstream_rings"
    package.mkdir()
    for name, file in (("__init__", None), ("plugin", "rings"), ("parts", "rings_parts")):
        (package / f"{name}.py").write_text((BROKEN / f"{file}.py").read_text() if file else "")
    lab.add("rings", "", entry_points="[gsstream]\nrings = gsstream_rings.plugin\n")
    return lab


def frames_of(stream: Path) -> list[int]:
    with Playback(stream) as playing:
        return [frame for frame, scene in playing if len(scene)]


def documented(message: str) -> None:
    """The page for users shows this very message, whatever line it is wrapped in."""
    words = " ".join(PAGE.read_text(encoding="utf-8").split())
    assert " ".join(message.split()) in words, f"docs/plugin-failures.md does not show: {message}"


def one_line(result, code: int) -> str:
    """The message of a command that failed as it should: one line, no traceback."""
    assert result.returncode == code, result.stdout + result.stderr
    # A run that fails later on also says what there is and how to go on.
    beside = ("warning: no fast renderer", "the stream in ")
    lines = [line for line in result.stderr.splitlines() if not line.startswith(beside)]
    assert len(lines) == 1, result.stderr
    return lines[0].removeprefix("error: ")


def test_rings_one_and_two_import_and_declaration(drill) -> None:
    for fault in ("raises_at_import", "exits_at_import", "other_major", "newer_minor", "duplicate_name"):
        drill.install(fault)
    listing = drill.cli("plugins")
    assert listing.returncode == 0
    assert listing.stdout.count("quarantined: ") == 5
    assert re.search(r"^gate +sound ", listing.stdout, re.MULTILINE), "the healthy plugin is listed all the same"
    message = one_line(drill.cli("plugins", "raises_at_import"), 1)
    assert "ModuleNotFoundError: No module named 'a_package_nobody_has'" in message
    documented(message)
    documented(one_line(drill.cli("plugins", "gate/newer-gate"), 1))


def test_ring_three_construction(drill, tmp_path: Path) -> None:
    for part, message in {
        "needs-a-library": "gate 'needs-a-library' (from gsstream-rings 0.3) cannot be used: ModuleNotFoundError: "
        "No module named 'gsstream_absent'",
        "unbuildable": "gate 'unbuildable' (from gsstream-rings 0.3) could not be built: the licence server does not "
        "answer",
    }.items():
        assert one_line(drill.cli(*RUN, "--out", str(tmp_path / "out"), "--set", f"gate={part}"), 1) == message
        documented(message)
        assert not (tmp_path / "out").exists()
    wrong = drill.cli(*RUN, "--out", str(tmp_path / "out"), "--set", "gate=sound", "--set", "gate.shar=0.5")
    assert one_line(wrong, 2).endswith("unknown key 'gate.params.shar'; did you mean 'share'?")


FAULTS = {
    "confidence=raises": "confidence 'Raises' (from gsstream-rings) failed at frame 3: ZeroDivisionError: division by "
    "zero (parts.py:60)",
    "confidence=undefined": "confidence 'Undefined' (from gsstream-rings) failed at frame 3: estimate(): expected "
    "finite values, got nan at index [1] (1 of 23 values)",
    "propagation=short": "propagation 'Short' (from gsstream-rings) failed at frame 1: propagate(): expected shape "
    "[23], got [22]",
    "gate=tripping": "gate 'Tripping' (from gsstream-rings) failed at frame 1, iteration 0: RuntimeError: out of luck "
    "(parts.py:94)",
    "regularizer=taxing": "regularizer 'Taxing' (from gsstream-rings) failed at frame 1, iteration 0: penalty 'tax': "
    "expected one finite number, got inf",
}


@pytest.mark.parametrize("setting", FAULTS)
def test_rings_four_and_five_call_and_frame(drill, tmp_path: Path, setting: str) -> None:
    out = tmp_path / "out"
    command = [*RUN, "--set", setting, "--out", str(out)]
    message = one_line(drill.cli(*command), 1)
    assert message == FAULTS[setting]
    documented(message)
    last = int(re.findall(r"frame (\d+)", message)[0]) - 1
    assert frames_of(out / "stream.gss") == list(range(last + 1)), "what was written before plays"
    assert len((out / "metrics.jsonl").read_text().splitlines()) == last + 1

    if setting != "confidence=raises":
        return  # to the stream and to those who resume it, all of these are the same
    mended = drill.cli(*command, "--resume", DRILL_MENDED="1")
    assert mended.returncode == 0, mended.stderr
    assert frames_of(out / "stream.gss") == [0, 1, 2, 3, 4]
    whole = tmp_path / "whole"
    assert drill.cli(*RUN, "--set", setting, "--out", str(whole), DRILL_MENDED="1").returncode == 0
    assert (out / "stream.gss").read_bytes() == (whole / "stream.gss").read_bytes(), "as if nothing had happened"


def test_ring_five_a_failed_frame_is_repeated_when_the_recipe_says_so(drill, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = drill.cli(*RUN, "--set", "confidence=raises", "--set", "stream.on_error=repeat", "--out", str(out))
    assert run.returncode == 0, run.stderr
    assert frames_of(out / "stream.gss") == [0, 1, 2, 3, 4]
    for frame in (3, 4):
        warning = f"warning: frame {frame} repeats the one before it: {FAULTS['confidence=raises']}"
        assert warning.replace("failed at frame 3", f"failed at frame {frame}") in run.stderr
    documented(f"warning: frame 3 repeats the one before it: {FAULTS['confidence=raises']}")
    lines = (out / "metrics.jsonl").read_text().splitlines()
    assert ['"error"' in line for line in lines] == [False, False, False, True, True]
    with Playback(out / "stream.gss") as playing:
        scenes = [scene for _, scene in playing]
    assert (scenes[4].means == scenes[2].means).all()
    assert (scenes[2].means != scenes[1].means).any()


SOURCE = """
from gsstream.api import Source
from gsstream.input.recordings.open import open_source
from gsstream.spec import ComponentSpec, hookimpl


class Torn(Source):
    def __init__(self, uri, scale):
        self.inner = open_source("synthetic:frames=5&views=2&width=32&height=24&supersample=1", scale)

    @property
    def info(self):
        return self.inner.info

    def frame(self, index, split="train"):
        if index == 2:
            raise KeyError("chunk 2")
        return self.inner.frame(index, split)

    def points(self, kind="recording"):
        return self.inner.points(kind)


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="source", name="torn", target="gsstream_torn_plugin:Torn", summary="torn")]
"""


def test_a_source_that_fails_in_the_middle(lab, tmp_path: Path) -> None:
    lab.add("torn", SOURCE)
    out = tmp_path / "out"
    command = [*RUN, "--out", str(out)]
    command[2] = "torn:x"
    message = one_line(lab.cli(*command), 2)
    assert message == "Torn could not read frame 2: KeyError: 'chunk 2'"
    documented(message)
    assert frames_of(out / "stream.gss") == [0, 1]


def test_ring_six_a_process_that_dies_takes_nothing_with_it(drill, tmp_path: Path) -> None:
    """Methods run in the process of the command: a crash ends it, and the stream on disk is the way back."""
    parts = drill.folder / "gsstream_rings" / "parts.py"
    parts.write_text(parts.read_text().replace("1 / 0", "os.abort()"))
    out = tmp_path / "out"
    command = [*RUN, "--set", "confidence=raises", "--out", str(out)]
    assert drill.cli(*command).returncode < 0, "ended by a signal"
    assert frames_of(out / "stream.gss") == [0, 1, 2]
    assert drill.cli("info", str(out)).returncode == 0
    assert drill.cli(*command, "--resume", DRILL_MENDED="1").returncode == 0
    assert frames_of(out / "stream.gss") == [0, 1, 2, 3, 4]
