"""The same run gives the same bytes: again, with other threads, after a kill; what is not resumed.

Cuts at a known place, of runs of all kinds: test_resume.py.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import time
import weakref
from pathlib import Path

import pytest
from flow_runs import WORLD, arguments, encode, finish, metrics
from forked import Forked, gsstream

from gsstream.cli.main import run_command
from gsstream.encode import open_recording
from gsstream.engine.run.session import _stop_on_interrupt
from gsstream.packet import StreamReader

#: The one with most to remember; runs of ``dense`` are resumed all over the other files of this folder.
METHODS = ["s2gs-edge"]


@pytest.fixture(scope="module", params=METHODS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, bytes]:
    """(method, stream) of an undisturbed run of six frames."""
    return request.param, encode(tmp_path_factory.mktemp("whole"), method=request.param)


def resume(out: Path, method: str) -> bytes:
    return encode(out, "--resume", method=method)


def test_same_seed_same_bytes(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    assert encode(tmp_path / "again", method=whole[0]) == whole[1]
    assert encode(tmp_path / "other", "--set", "seed=1", method=whole[0]) != whole[1]


def test_threads_change_no_byte(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    method, once = whole
    # The number is read when the native pool starts, so this needs a process of its own; this one has another number.
    assert os.environ.get("GSSTREAM_THREADS", str(os.cpu_count())) != "3"
    assert finish(*arguments(tmp_path, method=method), GSSTREAM_THREADS="3", OMP_NUM_THREADS="3")[0] == 0
    assert (tmp_path / "stream.gss").read_bytes() == once


def test_killed_at_any_moment_it_resumes_to_the_same_bytes(tmp_path: Path, whole: tuple[str, bytes]) -> None:
    method, once = whole
    out = tmp_path / "o"
    process = Forked(arguments(out, method=method))
    wait_for((out / "stream.gss").exists, process)
    # From inside frame 0 to the last pictures. Not seeded on purpose: over time every moment is tried.
    delay = random.uniform(0, 2)
    time.sleep(delay)
    process.kill()
    process.communicate()
    resumed = gsstream(arguments(out, "--resume", method=method))
    assert resumed.returncode == 0, resumed.stderr
    assert (out / "stream.gss").read_bytes() == once, f"killed after {delay} s"
    assert [line["frame"] for line in metrics(out)] == list(range(6))


def wait_for(condition, process) -> None:
    deadline = time.monotonic() + 600
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("kept", ["nothing", "half a header", "header", "half a key packet"])
def test_a_torn_frame_0_is_made_again(tmp_path: Path, whole: tuple[str, bytes], kept: str) -> None:
    method, once = whole
    out = tmp_path / "o"
    out.mkdir()
    stream = out / "stream.gss"
    sizes = {"nothing": 0, "half a header": 9, "header": 16, "half a key packet": 500}
    stream.write_bytes(once[: sizes[kept]])
    (out / "metrics.jsonl").write_text("".join(json.dumps({"frame": n}) + "\n" for n in range(5)) + '{"fra')
    assert resume(out, method) == once
    assert [line["frame"] for line in metrics(out)] == list(range(6))


def refused(capsys: pytest.CaptureFixture[str], stream: Path, command: list[str]) -> str:
    """stderr of a command that must fail by code 2 and leave the stream alone."""
    before = stream.read_bytes()
    assert run_command(command) == 2
    assert stream.read_bytes() == before
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    return err


def test_another_recipe_or_recording_is_not_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path, "--frames", "2")
    stream = tmp_path / "stream.gss"
    err = refused(capsys, stream, arguments(tmp_path, "--resume", "--set", "seed=3", stream__epochs=4))
    assert "written with another recipe: seed, stream differ" in err
    assert "--overwrite" in err
    err = refused(capsys, stream, arguments(tmp_path, "--resume", method="s2gs-edge"))
    assert "written with another recipe: codec, confidence" in err
    err = refused(capsys, stream, arguments(tmp_path, "--resume", source="demo", first_frame__points="recording"))
    assert "made from the recording 'synthetic'" in err
    assert "resume with the same --source" in err


def test_damage_in_the_middle_is_not_cut_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path)
    stream = tmp_path / "stream.gss"
    with StreamReader(stream) as reader:
        entry = reader.frames[2]
    data = bytearray(stream.read_bytes())
    data[entry.offset + 40] ^= 1
    stream.write_bytes(data)
    assert run_command(arguments(tmp_path, "--resume")) == 1
    err = capsys.readouterr().err
    assert re.search(r"packet of frame 2 is damaged: its checksum does not match \(at byte \d+\)", err)
    assert stream.read_bytes() == data


def test_interrupt_ends_after_the_current_frame(tmp_path: Path) -> None:
    """Ctrl-C: code 130, a stream that plays, and --resume goes on to the bytes of an undisturbed run."""
    source, out = WORLD.replace("frames=6", "frames=40"), tmp_path / "o"
    options = {"source": source, "stream__epochs": 10}
    process = Forked(arguments(out, pictures=True, **options))
    wait_for(lambda: (out / "metrics.jsonl").exists() and metrics(out), process)
    os.kill(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130, err
    assert err == "interrupted\n"
    with StreamReader(out / "stream.gss") as reader:
        reader.check()
        done = len(reader.frames)
        assert reader.unfinished is None
    assert 1 <= done < 40
    assert [line["frame"] for line in metrics(out)] == list(range(done))
    assert (out / "contact_sheet.png").exists()


ENDS = [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "ended by SIGTERM")]


@pytest.mark.parametrize(("number", "code", "said"), ENDS)
def test_before_the_first_packet_it_stops_at_once(tmp_path: Path, number: str, code: int, said: str) -> None:
    """Nothing would be lost, and frame 0 would take hours here."""
    out, options = tmp_path / "o", {"first_frame__max_iterations": 10_000_000, "first_frame__epochs": 10_000_000}
    process = Forked(arguments(out, **options))
    stream = out / "stream.gss"
    wait_for(lambda: stream.exists() and stream.stat().st_size > 0, process)
    os.kill(process.pid, getattr(signal, number))
    _, err = process.communicate(timeout=600)
    assert (process.returncode, err) == (code, f"{said}\n")
    with StreamReader(stream) as reader:
        assert reader.entries == []
        assert reader.damage is None


#: Says in a file when frame 1 is in the works: an interrupt that comes before it ends the run at once.
FRAME_1_BEGINS = """
from pathlib import Path
from gsstream.engine.run.encoder import Encoder
encode = Encoder.encode
def noted(self, frame):
    if frame.index == 1:
        Path({!r}).touch()
    return encode(self, frame)
Encoder.encode = noted
"""


@pytest.mark.parametrize("ends", ["finalize", "__del__"])
def test_an_interrupt_that_comes_while_an_object_ends_is_not_lost(ends: str, capfd: pytest.CaptureFixture[str]) -> None:
    class Thing:
        if ends == "__del__":

            def __del__(self) -> None:
                signal.raise_signal(signal.SIGINT)

    def made_and_ended() -> None:
        thing = Thing()
        if ends == "finalize":
            weakref.finalize(thing, signal.raise_signal, signal.SIGINT)
        del thing
        time.sleep(60)

    with (
        open_recording("demo") as source,
        _stop_on_interrupt(lambda _: None, source, lambda: False),
        pytest.raises(KeyboardInterrupt),
    ):
        made_and_ended()
    assert "ignored" not in capfd.readouterr().err


def test_interrupted_twice_it_does_not_wait_for_the_frame(tmp_path: Path) -> None:
    out, begun = tmp_path / "o", tmp_path / "begun"
    process = Forked(arguments(out, stream__epochs=10_000), first=FRAME_1_BEGINS.format(str(begun)))
    wait_for(begun.exists, process)
    for _ in range(2):
        assert process.poll() is None
        os.kill(process.pid, signal.SIGINT)
        time.sleep(1)  # longer than a pass: two interrupts at once would count as one
    _, err = process.communicate(timeout=600)
    assert (process.returncode, err) == (130, "interrupted\n")
    with StreamReader(out / "stream.gss") as reader:
        assert [entry.frame for entry in reader.frames] == [0]
