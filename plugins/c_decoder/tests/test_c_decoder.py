"""The decoder in C: the suite and real streams bit for bit, all refusals, and mutants under sanitisers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from many_streams import play_all

from gsstream.packet import FORMAT_VERSION
from gsstream.packet.conformance import judge, load_cases, play_here, play_with
from gsstream.player.playback import Playback

HERE = Path(__file__).parent
SOURCES = sorted((HERE.parent / "src" / "c").glob("*.c"))
SUITE = HERE.parents[2] / "tests" / "conformance"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-math-errno")
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CC = shutil.which(os.environ.get("CC", "cc"))

pytestmark = pytest.mark.skipif(CC is None, reason="there is no C compiler")


def build(program: Path, main: Path, flags: Sequence[str]) -> Path:
    files = [str(path) for path in SOURCES if not path.name.startswith("gss_")]
    command = [str(CC), *STRICT, *flags, *files, str(main), "-lm", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return program


def sanitised(program: Path, main: Path) -> Path:
    source = program.with_suffix(".c")
    source.write_text("int main(void) { return 0; }\n")
    probe = [str(CC), *SANITISED, str(source), "-o", str(program)]
    if subprocess.run(probe, capture_output=True, timeout=60, check=False).returncode:
        pytest.skip("the C compiler has no AddressSanitizer")
    return build(program, main, SANITISED)


def source(name: str) -> Path:
    return HERE.parent / "src" / "c" / f"{name}.c"


@pytest.fixture(scope="module")
def dump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("c") / "gss_dump", source("gss_dump"), ["-O2"])


def test_all_vectors_are_played_and_refused(dump: Path) -> None:
    cases = load_cases(SUITE)
    outcomes = play_all([str(dump)], cases)
    results = [judge(case, outcome) for case, outcome in zip(cases, outcomes, strict=True)]
    assert [result for result in results if result.problem or result.left_out] == []


def test_a_process_of_its_own_prints_the_same_and_its_code_says_how_a_stream_ended(dump: Path) -> None:
    """What the contract asks of a decoder; a few streams, each refused in another part of the decoder."""
    cases = load_cases(SUITE)
    chosen = [*[case for case in cases if not case.refused][::40], *[case for case in cases if case.refused][::20]]
    assert [play_with([str(dump)])(case.path) for case in chosen] == play_all([str(dump)], chosen)
    assert play_with([str(dump)])(SUITE / "play" / "nothing.gss").code == 2


def test_vectors_and_mutants_under_sanitisers(tmp_path: Path) -> None:
    cases = load_cases(SUITE)
    outcomes = play_all([str(sanitised(tmp_path / "dump", source("gss_dump")))], cases)
    assert [r for case, outcome in zip(cases, outcomes, strict=True) if (r := judge(case, outcome)).problem] == []
    mutants = sanitised(tmp_path / "mutants", HERE / "mutants.c")
    seeds = [str(path) for path in sorted((SUITE / "play").iterdir())]
    done = subprocess.run([mutants, "0", "800", *seeds], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert " 0 refused" not in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("method", ["s2gs-edge", "stream3dgs"])
def test_a_stream_of_a_real_run(dump: Path, tmp_path: Path, method: str) -> None:
    run = [str(Path(sys.executable).with_name("gsstream")), "run", "--source", "demo", "--method", method]
    run += ["--frames", "2", "--set", "first_frame.max_iterations=200"]
    run += ["--out", str(tmp_path / "run"), "--no-pictures", "--quiet"]
    done = subprocess.run(run, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    stream = tmp_path / "run" / "stream.gss"
    expected = play_here(stream)
    assert len(expected.lines) == 2
    assert play_with([str(dump)])(stream) == expected


def test_the_background_follows_the_light(tmp_path: Path) -> None:
    """The hash of a frame has no background in it; the info program prints those that are new."""
    info = build(tmp_path / "gss_info", source("gss_info"), ["-O2"])
    stream = SUITE.parent / "packet" / "samples" / FORMAT_VERSION / "light.gss"
    done = subprocess.run([info, stream], capture_output=True, text=True, timeout=60, check=True)
    said = [line.partition(", background ")[2].split() for line in done.stdout.splitlines()[1:] if "background" in line]
    with Playback(stream) as playback:
        known = [playback.player_state(frame).meta.background for frame in playback.frames]
    new = [now for before, now in pairwise(known) if before != now]
    assert len(new) == 3
    assert np.array_equal(np.array(said, np.float32), np.array(new, np.float32))


def test_every_file_is_short_and_the_info_program_builds(tmp_path: Path) -> None:
    assert max(len(path.read_text().splitlines()) for path in SOURCES) <= 400
    info = build(tmp_path / "gss_info", source("gss_info"), ["-O2"])
    shown = subprocess.run(
        [info, SUITE / "play" / "key-degree-3.gss"], capture_output=True, text=True, timeout=60, check=True
    )
    assert "15 harmonics" in shown.stdout
