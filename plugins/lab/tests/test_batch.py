"""A list of recordings: the same bytes wherever they are encoded, nothing lost and nothing made twice."""

from __future__ import annotations

import importlib.util
import itertools
import json
import threading
import time
from pathlib import Path

import batch_works
import pytest
import stores
from gsstream_lab.batch import drive
from gsstream_lab.batch.drive import MARGIN, run_batch
from gsstream_lab.batch.plan import Task, read_batch
from gsstream_lab.batch.work import NOTE, BatchJob, run_batch_job
from gsstream_lab.jobs.base import Finished
from gsstream_lab.jobs.executor import LocalExecutor, make_executor

from gsstream.cli.main import run_command
from gsstream.core.errors import RecipeError
from gsstream.discovery.catalog import load_catalog
from gsstream.input.recordings.open import DEMO_FOLDER
from gsstream.store.place import place_at

NAMES = itertools.count()
SET = "{frames: 2, first_frame: {max_iterations: 10, points: recording}}"
LIST = f"""
method: s2gs-edge
set: {SET}
recordings:
  - {{name: pickblocks_tiny_160, uri: WHERE, scale: 0.5}}
  - {{name: again, uri: WHERE, scale: 0.25, set: {{seed: 3}}}}
"""
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray (extra: ray)")


def tasks_of(folder: Path, where: str = str(DEMO_FOLDER), text: str = LIST) -> list[Task]:
    (folder / "list.yaml").write_text(text.replace("WHERE", where))
    return read_batch(folder / "list.yaml", load_catalog().recipe_path)


def streams(to: str) -> dict[str, bytes]:
    """Name of a recording -> bytes of its stream."""
    place = place_at(to)
    return {n.split("/")[0].rpartition("-")[0]: place.read(n) for n in place.names() if n.endswith("stream.gss")}


def encoded(tasks: list[Task], to: str, executor=None, work=run_batch_job) -> tuple[object, list[str]]:
    said: list[str] = []
    return run_batch(tasks, place_at(to), executor or LocalExecutor(1, 1, work), say=said.append), said


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The streams that one worker makes of a folder, one after the other."""
    folder = tmp_path_factory.mktemp("serial")
    result, said = encoded(tasks_of(folder), str(folder / "to"))
    assert (result.made, result.kept, dict(result.failed)) == (2, 0, {})
    assert [line.split()[:2] for line in said[1:]] == [["[1/2]", "pickblocks_tiny_160"], ["[2/2]", "again"]]
    return streams(str(folder / "to"))


def test_two_workers_make_the_same_bytes(serial: dict[str, bytes], tmp_path: Path) -> None:
    encoded(tasks_of(tmp_path), str(tmp_path / "to"), LocalExecutor(2, 1, run_batch_job))
    assert streams(str(tmp_path / "to")) == serial
    assert len(serial) == 2


def test_from_s3_to_s3_the_bytes_are_the_same(serial: dict[str, bytes], tmp_path: Path) -> None:
    with stores.bucket(f"batch-{next(NAMES)}", tmp_path / "cache") as bucket:
        bucket.upload(DEMO_FOLDER, "takes/pickblocks_tiny_160")
        tasks = tasks_of(tmp_path, f"{bucket.address}/takes/pickblocks_tiny_160")
        to = f"{bucket.address}/streams"
        result, _ = encoded(tasks, to, LocalExecutor(2, 1, run_batch_job))
        assert dict(result.failed) == {}
        assert streams(to) == serial
        before = bucket.files()
        assert encoded(tasks, to, work=batch_works.die_once)[0].kept == 2
        assert bucket.files() == before
        assert not [name for name, data in before.items() if b"secret-of-the-test" in data]


@needs_ray
def test_on_ray_with_another_cache_the_bytes_are_the_same(
    serial: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stores.bucket(f"batch-{next(NAMES)}", tmp_path / "here") as bucket:
        bucket.upload(DEMO_FOLDER, "takes/pickblocks_tiny_160")
        tasks = tasks_of(tmp_path, f"{bucket.address}/takes/pickblocks_tiny_160")
        encoded(tasks[:1], f"{bucket.address}/one")
        monkeypatch.setenv("GSSTREAM_CACHE", str(tmp_path / "there"))
        # More than any machine has: the largest has to do.
        monkeypatch.setattr(drive, "BatchJob", lambda *a, **facts: BatchJob(*a, **(facts | {"memory": 1 << 50})))
        executor = make_executor(run_batch_job, 2, 1, ray="local")
        result, _ = encoded(tasks, f"{bucket.address}/two", executor)
        assert dict(result.failed) == {}
        assert streams(f"{bucket.address}/two") == serial
        assert streams(f"{bucket.address}/one").items() <= serial.items()


def test_a_worker_that_is_killed_is_followed_by_another(
    serial: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "marks").mkdir()
    monkeypatch.setenv("BATCH_TEST_MARKS", str(tmp_path / "marks"))
    result, said = encoded(tasks_of(tmp_path), str(tmp_path / "to"), work=batch_works.die_once)
    assert (result.made, dict(result.failed)) == (2, {})
    assert sum("killed by SIGKILL; out of memory?; once more" in line for line in said) == 2
    assert streams(str(tmp_path / "to")) == serial


def test_the_store_is_stopped_in_the_middle_and_nothing_is_lost(
    serial: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes before the workers fetch the recording for the first time, and comes while they wait for it."""
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("BATCH_TEST_MARKS", str(tmp_path / "marks"))
    with stores.bucket(f"batch-{next(NAMES)}", tmp_path / "cache") as bucket:
        bucket.upload(DEMO_FOLDER, "takes/pickblocks_tiny_160")
        tasks = tasks_of(tmp_path, f"{bucket.address}/takes/pickblocks_tiny_160")
        to = f"{bucket.address}/streams"

        def away() -> None:
            while len(list(marks.glob("begun-*"))) < 2:
                time.sleep(0.05)
            bucket.stop()
            (marks / "go").touch()
            time.sleep(10)
            bucket.start()

        thread = threading.Thread(target=away)
        thread.start()
        result, _ = encoded(tasks, to, LocalExecutor(2, 1, batch_works.wait_then_run))
        thread.join()
        assert dict(result.failed) == {}
        assert streams(to) == serial


def test_a_result_without_its_note_is_made_again(tmp_path: Path) -> None:
    tasks, to = tasks_of(tmp_path), str(tmp_path / "to")
    encoded(tasks, to, work=batch_works.make)
    (tmp_path / "to" / tasks[1].folder / NOTE).unlink()
    (tmp_path / "to" / tasks[0].folder / NOTE).write_text(json.dumps(batch_works.FACTS))
    result, said = encoded(tasks, to, work=batch_works.make)
    assert (result.made, result.kept) == (1, 1)
    assert said[1].endswith("kept")
    assert said[2].endswith("made")


def test_a_recording_that_fails_is_named_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = LIST.replace("uri: WHERE, scale: 0.25", "uri: nowhere, scale: 0.25")
    tasks_of(tmp_path, text=text)
    command = ["batch", str(tmp_path / "list.yaml"), "--to", str(tmp_path / "to"), "--workers", "1"]
    assert run_command(command) == 1
    out, err = capsys.readouterr()
    assert "1 stream made, 0 kept" in out
    assert "1 recording failed; the same command tries them again:\n  again: SourceError: source 'nowhere': no" in err
    assert list(streams(str(tmp_path / "to"))) == ["pickblocks_tiny_160"]


class Asked:
    """An executor that does nothing but note what is asked of it."""

    slots = 1

    def __init__(self) -> None:
        self.jobs: list[object] = []

    def submit(self, job: object) -> None:
        self.jobs.append(job)

    def next(self) -> Finished:
        return Finished(self.jobs[-1].id, batch_works.make(self.jobs[-1]))

    def close(self) -> None:
        pass


def test_memory_is_asked_for_as_the_runs_before_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = LIST.replace(", scale: 0.25, set: {seed: 3}", ", scale: 0.5")
    tasks, executor = tasks_of(tmp_path, text=text.replace("uri: WHERE", "uri: demo", 1)), Asked()
    from gsstream.recipe.load import recipe_hash

    monkeypatch.setitem(batch_works.FACTS, "recipe", recipe_hash(tasks[0].resolved.recipe))
    encoded(tasks, str(tmp_path / "to"), executor)
    assert [job.memory for job in executor.jobs] == [0, int(MARGIN * 100e6)]


def test_what_is_the_same_has_the_same_name_and_nothing_else_has(tmp_path: Path) -> None:
    (one, two), (renamed, _) = tasks_of(tmp_path), tasks_of(tmp_path, text=LIST.replace("name: pick", "name: Pick"))
    assert one.id == renamed.id
    others = [
        two,
        *tasks_of(tmp_path, text=LIST.replace("s2gs-edge", "hold")),
        *tasks_of(tmp_path, where="demo"),
        *tasks_of(tmp_path, text=LIST.replace("frames: 2", "frames: 3")),
    ]
    ids = [one.id, *(task.id for task in others)]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LIST.replace("method", "methd"), "unknown key 'methd'; did you mean 'method'?"),
        (LIST.replace("again", "pickblocks_tiny_160"), "two recordings have the same name"),
        (LIST.replace("frames: 2", "frame: 2"), "unknown key 'frame'; did you mean 'frames'?"),
        ("method: dense\nrecordings: []\n", "recordings"),
    ],
)
def test_a_list_that_is_wrong_says_where(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(RecipeError, match=r".") as caught:
        tasks_of(tmp_path, text=text)
    assert said in str(caught.value)
