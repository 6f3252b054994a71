"""A place for files, by its address: a folder, or what lies below a name in a store of objects."""

from __future__ import annotations

import importlib.util
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from gsstream.core.errors import InputError, OutputError, SourceError
from gsstream.core.install_hints import install_extra
from gsstream.store.address import SCHEMES, checked_address, is_address
from gsstream.store.troubles import store_errors

#: Requests at a time: most files of a recording are small, and wait for answers longer than for their bytes.
AT_ONCE = 16


class Listed(NamedTuple):
    """A file of a place: ``mark`` changes when the file does (etag, or the time of its last change)."""

    name: str
    size: int
    mark: str


class Place(ABC):
    """Where files are put. A file is there completely or not at all; errors are OutputError."""

    address: str

    @abstractmethod
    def names(self, below: str = "") -> list[str]:
        """Return the names of the files whose name begins with ``below``, sorted."""

    @abstractmethod
    def read(self, name: str) -> bytes | None:
        """Return the bytes of a file; None when there is none."""

    @abstractmethod
    def put(self, name: str, data: bytes, *, kept: str = "") -> None:
        """Write a file. ``kept``: how long others may keep it, as HTTP says (Cache-Control)."""

    @abstractmethod
    def remove(self, names: Iterable[str]) -> None:
        """Remove files; those that are not there are no fault."""


def place_at(address: str | os.PathLike[str]) -> Place:
    """Return a place. Raises InputError for an address that cannot be one, or without what speaks to its store."""
    text = os.fspath(address)
    return Store(text, OutputError) if is_address(text) else Folder(Path(text))


class Folder(Place):
    """A folder of this machine, which is made with its first file."""

    def __init__(self, path: Path) -> None:
        self.path, self.address = path, str(path)

    def names(self, below: str = "") -> list[str]:
        """Return the names of the files, without those that are only half written."""
        found = (path for path in self.path.rglob("*") if path.is_file() and not path.name.startswith("."))
        return sorted(name for path in found if (name := path.relative_to(self.path).as_posix()).startswith(below))

    def read(self, name: str) -> bytes | None:
        """Return the bytes of a file; None when there is none."""
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OutputError(f"cannot read {self.path / name}: {error.strerror or error}") from error

    def put(self, name: str, data: bytes, *, kept: str = "") -> None:
        """Write beside the file and rename."""
        target = self.path / name
        beside = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            beside.write_bytes(data)
            beside.replace(target)
        except OSError as error:
            beside.unlink(missing_ok=True)
            raise OutputError(f"cannot write {target}: {error.strerror or error}") from error

    def remove(self, names: Iterable[str]) -> None:
        """Remove files."""
        for name in names:
            (self.path / name).unlink(missing_ok=True)


class Store(Place):
    """What lies below an address: s3://BUCKET/NAME, gs://BUCKET/NAME, https://SERVER/NAME (read only).

    Who asks is known from the environment (:func:`gsstream.store.address.how_to_sign`), never from the address.
    ``kind``: the error that is raised.
    """

    def __init__(self, address: str, kind: type[InputError] = SourceError) -> None:
        self.address, self.kind = checked_address(address), kind
        scheme = urlsplit(address).scheme
        for name in ("fsspec", SCHEMES[scheme]):
            if importlib.util.find_spec(name) is None:
                cure = "pip install gcsfs" if name == "gcsfs" else install_extra("cloud")
                raise InputError(f"{address}: addresses of {scheme} need {name}, which is not installed: {cure}")
        self.scheme, self.web = scheme, scheme in ("http", "https")
        with store_errors(self.address, kind):
            import fsspec

            # Not the instance that fsspec keeps: the environment may have changed since it was made.
            self._files: Any = fsspec.filesystem(scheme, skip_instance_cache=True, use_listings_cache=False)
        self._root: str = self.address if self.web else self._files._strip_protocol(self.address)

    def listing(self) -> list[Listed]:
        """Return all files below the address, sorted by name.

        Raises ``kind`` when there are none, and for a name that would leave the folder that they are copied to.
        """
        with store_errors(self.address, self.kind):
            found: Mapping[str, Mapping[str, Any]] = self._files.find(self._root, detail=True)
            found = {path: fact for path, fact in found.items() if path.startswith(f"{self._root}/")}
            found = {path: fact for path, fact in found.items() if not (self.web and {"?", "#"} & set(path))}
            if self.web:  # an index page lists only names
                with ThreadPoolExecutor(AT_ONCE) as pool:
                    found = dict(zip(found, pool.map(self._files.info, found), strict=True))
            files = [self._listed(path, fact) for path, fact in found.items() if not path.endswith("/")]
        if not files:
            pages = " (of a web server, its page of links is read)" if self.web else ""
            raise self.kind(f"{self.address}: nothing is there; expected the files of a folder{pages}")
        self._check(files)
        return sorted(files)

    def fetch(self, name: str, target: Path) -> None:
        """Copy a file of the listing to ``target``."""
        with store_errors(f"{self.address}/{name}", self.kind):
            self._files.get_file(self._path(name), str(target))

    def names(self, below: str = "") -> list[str]:
        """Return the names of the files."""
        with store_errors(self.address, self.kind):
            found = self._files.find(self._root)
        short = (path[len(self._root) + 1 :] for path in found if path.startswith(f"{self._root}/"))
        return sorted(name for name in short if name.startswith(below) and not name.endswith("/"))

    def read(self, name: str) -> bytes | None:
        """Return the bytes of a file; None when there is none."""
        with store_errors(f"{self.address}/{name}", self.kind):
            try:
                return bytes(self._files.cat_file(self._path(name)))
            except FileNotFoundError:
                return None

    def put(self, name: str, data: bytes, *, kept: str = "") -> None:
        """Write an object in one request."""
        if self.web:
            raise self.kind(f"{self.address}: a web server takes no files; name a bucket (s3://, gs://) or a folder")
        headers: dict[str, Any] = {}
        if kept and self.scheme == "s3":
            headers["CacheControl"] = kept
        elif kept:
            headers["fixed_key_metadata"] = {"cache_control": kept}
        with store_errors(f"{self.address}/{name}", self.kind):
            self._files.pipe_file(self._path(name), data, **headers)

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects."""
        paths = [self._path(name) for name in names]
        if paths:
            with store_errors(self.address, self.kind):
                self._files.rm(paths)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _listed(self, path: str, fact: Mapping[str, Any]) -> Listed:
        mark = next((str(fact[key]) for key in ("ETag", "etag", "md5Hash", "Last-Modified") if fact.get(key)), "")
        if fact.get("size") is None:
            raise self.kind(f"{path}: the server does not say how large this file is, so no copy could be checked")
        return Listed(path[len(self._root) + 1 :], int(fact["size"]), mark)

    def _check(self, files: list[Listed]) -> None:
        """Refuse names that are no place below the folder, or two at one place."""
        places = {self.local_name(file.name) for file in files}
        for name in places:
            parts = name.split("/")
            if {"", ".", ".."} & set(parts) or "\\" in name or not name.isprintable():
                raise self.kind(f"{self.address}: the store lists {name!r}, which is no name of a file below it")
            above = {"/".join(parts[:count]) for count in range(1, len(parts))} & places
            if above:
                raise self.kind(f"{self.address}: {min(above)!r} is a file and a folder there; rename one of them")

    def local_name(self, name: str) -> str:
        """Return the name of a file as a folder holds it: links of a page are escaped."""
        return unquote(name) if self.web else name
