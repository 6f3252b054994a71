"""Recordings by address: whole copies that are named by what the store lists, and every fault as one sentence."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import stores

from gsstream.core.errors import InputError, SourceError
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.store.cache import SIZE, WHOLE, Lock, cache_folder
from gsstream.store.fetch import fetched, told_to
from gsstream.store.place import Store

NAMES = itertools.count()


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[stores.Bucket]:
    with stores.bucket(f"recordings-{next(NAMES)}", tmp_path / "cache") as made:
        yield made


def copies() -> list[str]:
    return sorted(path.name for path in cache_folder().iterdir() if (path / WHOLE).exists())


def test_a_recording_in_s3_is_the_recording(bucket: stores.Bucket) -> None:
    bucket.upload(DEMO_FOLDER, "takes/pickblocks_tiny_160")
    address = f"{bucket.address}/takes/pickblocks_tiny_160"
    here, there = open_source(str(DEMO_FOLDER)), open_source(address)
    assert there.info.uri == address
    assert there.info.name == here.info.name
    assert (there.stored_frame(3).images == here.stored_frame(3).images).all()
    there.close()
    told: list[str] = []
    with told_to(told.append):
        open_source(f"folder:{address}/").close()
    assert told == [], "the copy is there: nothing is fetched again"
    assert len(copies()) == 1


def test_a_recording_of_a_web_server_is_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("s3fs", reason="no https without fsspec and aiohttp")
    monkeypatch.setenv("GSSTREAM_CACHE", str(tmp_path / "cache"))
    shutil.copytree(DEMO_FOLDER, tmp_path / "web" / "a take")
    with stores.web_server(tmp_path / "web") as (address, asked):
        source = open_source(f"{address}/a take")
        assert (source.stored_frame(1).images == open_source(str(DEMO_FOLDER)).stored_frame(1).images).all()
        source.close()
        fetched_once = sum(line.startswith("GET") and line.endswith(".jpg") for line in asked)
        open_source(f"{address}/a take").close()
        assert sum(line.startswith("GET") and line.endswith(".jpg") for line in asked) == fetched_once
    assert fetched_once == len(list(DEMO_FOLDER.rglob("*.jpg")))


def test_another_version_is_another_copy(bucket: stores.Bucket) -> None:
    bucket.put("take/cameras.json", b"one")
    first = fetched(f"{bucket.address}/take")
    bucket.put("take/cameras.json", b"two")
    second = fetched(f"{bucket.address}/take")
    assert (first.folder / "cameras.json").read_bytes() == b"one"
    assert (second.folder / "cameras.json").read_bytes() == b"two"
    assert first.folder.name == second.folder.name == "take"
    first.close()
    second.close()


def test_a_copy_that_was_cut_off_goes_on_with_what_it_lacks(
    bucket: stores.Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(60):
        bucket.put(f"take/{number:02d}", bytes(100 + number))
    plain, asked = Store.fetch, list[str]()

    def cut(store: Store, name: str, target: Path) -> None:
        if len(asked) == 40:
            bucket.stop()
        asked.append(name)
        plain(store, name, target)

    monkeypatch.setattr(Store, "fetch", cut)
    with pytest.raises(SourceError, match="the store does not answer; look at the network"):
        fetched(f"{bucket.address}/take")
    (entry,) = [path for path in cache_folder().iterdir() if path.is_dir()]
    there = {path.name for path in (entry / "take").iterdir() if not path.name.startswith(".")}
    assert 25 <= len(there) < 60
    assert not (entry / WHOLE).exists()
    bucket.start()
    again: list[str] = []

    def count(store: Store, name: str, target: Path) -> None:
        again.append(name)
        plain(store, name, target)

    monkeypatch.setattr(Store, "fetch", count)
    copy = fetched(f"{bucket.address}/take")
    assert set(again) == {f"{number:02d}" for number in range(60)} - there
    assert [path.stat().st_size for path in sorted(copy.folder.iterdir())] == [100 + number for number in range(60)]
    copy.close()


def test_the_oldest_copy_that_nobody_uses_makes_room(bucket: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSSTREAM_CACHE_SIZE", "2500B")
    for name in "abcd":
        bucket.put(f"{name}/data", name.encode() * 1000)
    a, b = fetched(f"{bucket.address}/a"), fetched(f"{bucket.address}/b")
    with pytest.raises(SourceError, match=r"may hold 2.5KB, and 2KB of it are in use: set GSSTREAM_CACHE_SIZE"):
        fetched(f"{bucket.address}/c")
    for age, copy in ((100, b), (200, a)):
        os.utime(copy.folder.parent / SIZE, (age, age))
    a.close()  # younger than b by its last use, but b is used
    c = fetched(f"{bucket.address}/c")
    assert not a.folder.exists()
    assert (b.folder / "data").read_bytes() == b"b" * 1000
    b.close()
    c.close()
    os.utime(b.folder.parent / SIZE, (300, 300))
    fetched(f"{bucket.address}/d").close()
    assert c.folder.exists(), "b was used longest ago"
    assert not b.folder.exists()


def test_two_processes_fetch_once(bucket: stores.Bucket) -> None:
    """The second waits for the first, which holds the entry alone while it copies."""
    bucket.put("take/data", b"x")
    copy = fetched(f"{bucket.address}/take")
    other = Lock(copy.folder.parent)
    assert not other.if_unused(), "a copy in use is nobody else's to remove"
    copy.close()
    assert other.if_unused()
    other.close()


def _changed(bucket: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Store.fetch

    def changing(store: Store, name: str, target: Path) -> None:
        plain(store, name, target)
        bucket.put("take/b", b"B")

    monkeypatch.setattr(Store, "fetch", changing)


def _longer(bucket: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Store.fetch

    def changing(store: Store, name: str, target: Path) -> None:
        bucket.put("take/b", b"longer")
        plain(store, name, target)

    monkeypatch.setattr(Store, "fetch", changing)


def _environment(**variables: str) -> Callable[[stores.Bucket, pytest.MonkeyPatch], None]:
    def change(_: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return change


def _unknown(_: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", "/nonexistent")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent/credentials")


def _refused(bucket: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", bucket.beside.enter_context(stores.refusing_store()))


def _full(_: stores.Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage("/")._replace(free=1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)


def _stopped(bucket: stores.Bucket, _: pytest.MonkeyPatch) -> None:
    bucket.stop()


def _nothing(*_: object) -> None:
    pass


@pytest.mark.parametrize(
    ("address", "before", "sentence"),
    [
        ("take", _unknown, "s3: no credentials found for s3://{b}/take; set AWS_PROFILE, or AWS_ACCESS_KEY_ID"),
        ("take", _refused, "the store refuses this account; look at its rights"),
        ("tale", _nothing, "s3://{b}/tale: nothing is there; expected the files of a folder"),
        ("take/a", _nothing, "s3://{b}/take/a: nothing is there; expected the files of a folder"),
        ("take", _changed, "s3://{b}/take/b: this object changed while the recording was fetched"),
        ("take", _longer, "s3://{b}/take/b: 6 bytes came, 1 are listed"),
        ("take", _full, "the recording needs 2B more in"),
        ("take", _stopped, "the store does not answer; look at the network and the address"),
        ("take", _environment(GSSTREAM_CACHE_SIZE="1B"), "the cache {c} may hold 1B: set GSSTREAM_CACHE_SIZE"),
        ("take", _environment(GSSTREAM_CACHE_SIZE="many"), "GSSTREAM_CACHE_SIZE=many: expected a number and a unit"),
        ("take", _environment(GSSTREAM_CACHE="/proc/nothing"), "the cache /proc/nothing cannot be used"),
        ("odd", _nothing, "the store lists '../up', which is no name of a file below it"),
        ("both", _nothing, "'x' is a file and a folder there; rename one of them"),
    ],
)
def test_every_fault_is_one_sentence(
    bucket: stores.Bucket,
    monkeypatch: pytest.MonkeyPatch,
    address: str,
    before: Callable[[stores.Bucket, pytest.MonkeyPatch], None],
    sentence: str,
) -> None:
    for name in ("take/a", "take/b", "odd/../up", "both/x", "both/x/y"):
        bucket.put(name, b"1")
    cache = str(cache_folder())
    before(bucket, monkeypatch)
    with pytest.raises(SourceError) as caught:
        fetched(f"{bucket.address}/{address}")
    told = str(caught.value)
    assert sentence.format(b=bucket.name, c=cache) in told
    assert "\n" not in told
    assert "secret-of-the-test" not in told
    assert not list(cache_folder().glob(f"*/{WHOLE}"))


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("s3://NAME:HIDDEN@bucket/take", "s3://.../take: an address holds no user, password or ?query"),
        ("https://server/take?X-Amz-Signature=HIDDEN", "https://.../take: an address holds no user, password"),
        ("https://server/take#HIDDEN", "https://.../take: an address holds no user, password"),
        ("s3:///take", "the address does not name a bucket; expected e.g. s3://NAME/FOLDER"),
        ("https:///take", "the address does not name a server"),
        ("s3://bucket/take/../other", "the address goes up by '..'"),
        ("gs://bucket/take", "addresses of gs need gcsfs, which is not installed: pip install gcsfs"),
    ],
)
def test_an_address_that_cannot_be_one_is_refused_and_its_secret_not_repeated(address: str, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        open_source(address)
    assert sentence in str(caught.value)
    assert "HIDDEN" not in str(caught.value)


def test_without_the_extra_the_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    plain = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "s3fs" else plain(name))
    with pytest.raises(InputError, match=r"addresses of s3 need s3fs, which is not installed: .*gsstream\[cloud\]"):
        open_source("s3://bucket/take")
