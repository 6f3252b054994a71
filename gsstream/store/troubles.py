"""What goes wrong with a store, each as one sentence without a secret."""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar
from urllib.parse import urlsplit

from gsstream.core.errors import GsstreamError, InputError, OutputError, SourceError
from gsstream.store.address import how_to_sign

T = TypeVar("T")
#: Seconds between two tries.
PAUSE = 1.0
_UNSIGNED = re.compile(r"Credential|ProfileNotFound|SSO|TokenRetrieval")
#: Names of the errors that botocore and aiohttp raise when nobody answers; both are imported only by fsspec.
_SILENT = re.compile(r"Timeout|Connect|Disconnected|Payload|IncompleteRead|HTTPClient|ClientOSError")
#: What may follow in a message and may hold a signature.
_SECRET = re.compile(r"\?\S+|(?i:(authorization|credential|signature|secret|token|key)\w*\s*[=:]\s*)\S+")


class StoreSilent(SourceError, OutputError):
    """A store that does not answer now, and may later; whether it was to be read or written, that is all there is."""


@contextmanager
def store_errors(address: str, kind: type[InputError]) -> Iterator[None]:
    """Raise what a store says as an error of ``kind``, and StoreSilent where waiting may help."""
    try:
        yield
    except GsstreamError:
        raise
    except Exception as error:  # three libraries, whose errors share no base
        raise _told(error, address, kind) from None


def patiently(do: Callable[[], T], seconds: float, silent: Callable[[StoreSilent], object] = lambda _: None) -> T:
    """Return what ``do`` returns, and try again while the store does not answer, for as long as that; say so once."""
    deadline = time.monotonic() + seconds
    told = False
    while True:
        try:
            return do()
        except StoreSilent as error:
            if time.monotonic() > deadline:
                raise
            if not told:
                silent(error)
            told = True
            time.sleep(PAUSE)


def _told(error: Exception, address: str, kind: type[InputError]) -> InputError:
    parts = urlsplit(address)
    name, status = type(error).__name__, getattr(error, "status", None)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return kind(f"{address}: the disk is full; make room, or set GSSTREAM_CACHE to a folder on another one")
    if _UNSIGNED.search(name):
        return kind(f"{parts.scheme}: no credentials found for {address}; {how_to_sign(parts.scheme)}")
    if isinstance(error, PermissionError) or status in (401, 403):
        return kind(f"{address}: the store refuses this account; look at its rights, or {how_to_sign(parts.scheme)}")
    if isinstance(error, FileNotFoundError) or status == 404:
        return kind(f"{address}: nothing is there; look for a mistake in the address")
    if isinstance(error, ConnectionError | TimeoutError) or _SILENT.search(name) or (status or 0) >= 500:
        what = f"answers {status}" if status else "does not answer"
        return StoreSilent(f"{address}: the store {what}; look at the network and the address, then try again")
    said = _SECRET.sub("...", str(error))[:200]
    return kind(f"{address}: the store says: {said or name}")
