"""Whole copies of what lies at an address: an encoder reads every picture once or six times, and wants files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from gsstream.core.errors import InputError, SourceError
from gsstream.core.names import last_part
from gsstream.store.cache import SIZE, WHOLE, Lock, cache_folder, make_room, told
from gsstream.store.place import AT_ONCE, Listed, Store

_tell: ContextVar[Callable[[str], None] | None] = ContextVar("tell", default=None)
#: Files after which the one who waits hears how far it is.
_EVERY = 25


@contextmanager
def told_to(tell: Callable[[str], None]) -> Iterator[None]:
    """Let ``tell`` hear what is being fetched while this is open."""
    token = _tell.set(tell)
    try:
        yield
    finally:
        _tell.reset(token)


class Fetched:
    """A whole copy in the cache: ``folder`` has the name of what was asked for. Nobody removes it before ``close``."""

    def __init__(self, folder: Path, lock: Lock) -> None:
        self.folder, self._lock = folder, lock

    def close(self) -> None:
        """Let the cache remove the copy when it needs room."""
        self._lock.close()


def fetched(address: str) -> Fetched:
    """Copy what lies below an address into the cache, unless it is there, and hold it.

    The copy is named by a digest of the address and of what the store lists (names, sizes, etags), so that another
    version is another copy. A copy that was cut off goes on with the files that it lacks.

    Raises SourceError when nothing is there, an object changes meanwhile, the store refuses or does not answer, or
    there is no room.
    """
    try:
        store = Store(address)
        return _copy(store, store.listing())
    except OSError as error:
        raise SourceError(f"the cache {cache_folder()} cannot be used: {error.strerror or error}") from error
    except InputError as error:
        raise error if isinstance(error, SourceError) else SourceError(str(error)) from error


def _copy(store: Store, listing: list[Listed]) -> Fetched:
    text = json.dumps([store.address, listing])
    entry = cache_folder() / hashlib.sha256(text.encode()).hexdigest()[:24]
    folder = entry / (store.local_name(last_part(store.address)) or "recording")
    lock = Lock(entry)
    try:
        while True:
            lock.alone()
            if not (entry / WHOLE).exists():
                _complete(store, listing, entry, folder)
            os.utime(entry / SIZE)
            lock.shared()  # for a moment nobody has it
            if (entry / WHOLE).exists():
                return Fetched(folder, lock)
    except BaseException:
        lock.close()
        raise


def _complete(store: Store, listing: list[Listed], entry: Path, folder: Path) -> None:
    """Fetch the files that are missing, and see whether they are still what was listed."""
    missing = [file for file in listing if not _is_there(folder / store.local_name(file.name), file)]
    size, done = sum(file.size for file in missing), 0
    make_room(entry.parent, entry, size=sum(file.size for file in listing), missing=size)
    with ThreadPoolExecutor(AT_ONCE, "fetch") as pool:
        # A few are handed over at a time, so that the first error is not the last to be heard of.
        for begin in range(0, len(missing), _EVERY):
            tell = _tell.get()
            if tell is not None:
                tell(f"fetching {store.address}: {told(done)} of {told(size)}")
            some = missing[begin : begin + _EVERY]
            jobs = [pool.submit(_fetch, store, file, folder) for file in some]
            wait(jobs, return_when=FIRST_EXCEPTION)
            for job in jobs:
                job.cancel()
            for job in jobs:
                if not job.cancelled():
                    job.result()
            done += sum(file.size for file in some)
    try:
        _compare(listing, store)
    except SourceError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    (entry / WHOLE).touch()


def _fetch(store: Store, file: Listed, folder: Path) -> None:
    target = folder / store.local_name(file.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.part")
    store.fetch(file.name, beside)
    size = beside.stat().st_size
    if size != file.size:
        beside.unlink()
        raise SourceError(
            f"{store.address}/{file.name}: {size} bytes came, {file.size} are listed: it is being changed, or the "
            "connection was cut; try again"
        )
    beside.replace(target)


def _is_there(path: Path, file: Listed) -> bool:
    return path.is_file() and path.stat().st_size == file.size


def _compare(before: list[Listed], store: Store) -> None:
    """Raise SourceError naming the first object that is not what it was when the copy began."""
    after = store.listing()
    if after == before:
        return
    name = min(file.name for file in set(before) ^ set(after))
    raise SourceError(
        f"{store.address}/{name}: this object changed while the recording was fetched, so the copy may hold two "
        "versions; wait until nobody writes there, then try again"
    )
