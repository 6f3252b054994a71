"""A folder that is brought to a store while it is written. The file is the queue: whoever writes waits for nothing."""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from gsstream.core.errors import OutputError
from gsstream.store.place import Place
from gsstream.store.troubles import StoreSilent, patiently

#: Seconds between two looks at the folder, and bytes of the longest part: no more is in memory at a time.
LOOK, LONGEST = 1.0, 8 << 20
#: Seconds that the end waits for a store that does not answer.
PATIENCE = 60.0
#: Name of a part: where in the file it begins, and a digest of its bytes.
_PART = re.compile(r"(\d{12})-([0-9a-f]{16})")


class Mirror:
    """Brings a folder to a place: files that only grow as parts meanwhile, everything whole at the end.

    A part never changes: ``NAME.parts/OFFSET-DIGEST``. The parts of a file that is not ended are a beginning of it, so
    that a machine which is lost takes with it only the last seconds. When the whole file is there its parts go.
    """

    def __init__(self, folder: Path, place: Place, *, grows: Iterable[str], say: Callable[[str], None]) -> None:
        """``grows``: files to which is only appended. ``say``: is told once that the store does not answer."""
        self.folder, self.place, self.grows, self.say = folder, place, tuple(grows), say
        #: Name -> (where the last part begins, its bytes): the file goes on behind them.
        self._last: dict[str, tuple[int, bytes]] = {}
        self._over, self._warned = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="mirror", daemon=True)

    def __enter__(self) -> Mirror:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        self._over.set()
        self._thread.join()
        try:
            self.finish(PATIENCE)
        except OutputError as trouble:
            if error is None:
                raise
            error.add_note(str(trouble))

    def finish(self, patience: float) -> None:
        """Bring every file whole, within as many seconds. Raises OutputError when that fails; the folder keeps them."""
        try:
            patiently(self._bring_whole, patience, self._warn)
        except StoreSilent as error:
            raise OutputError(f"{error}. Everything is in {self.folder} meanwhile") from error

    def _run(self) -> None:
        while not self._over.wait(LOOK):
            try:
                for name in self.grows:
                    while self._send(name):
                        pass
            except StoreSilent as error:
                self._warn(error)
            except OutputError as error:  # told at the end, which meets the same: the run itself is sound
                self._warn(error)
                return

    def _send(self, name: str) -> bool:
        """Send what was appended to a file; say whether there is more."""
        file = self.folder / name
        at, last = self._last.get(name, (0, b""))
        # A run that goes on may have cut the end off that the run before it wrote.
        if name not in self._last or _bytes(file, at, len(last)) != last:
            at, last = self._last[name] = self._agreed(name)
        at += len(last)
        data = _bytes(file, at, LONGEST)
        if data:
            self.place.put(f"{name}.parts/{at:012d}-{hashlib.sha256(data).hexdigest()[:16]}", data)
            self._last[name] = at, data
        return len(data) == LONGEST

    def _agreed(self, name: str) -> tuple[int, bytes]:
        """Return the last of the parts that are there already and say what the file says; the others go."""
        parts, at, last = self.place.names(f"{name}.parts/"), 0, b""
        for count, part in enumerate(parts):
            match = _PART.fullmatch(part.rpartition("/")[2])
            data = self.place.read(part) if match and int(match[1]) == at + len(last) else None
            if data is None or _bytes(self.folder / name, at + len(last), len(data)) != data:
                self.place.remove(parts[count:])
                break
            at, last = at + len(last), data
        return at, last

    def _bring_whole(self) -> None:
        # The files that grow last: who finds the whole stream finds all that belongs to it.
        names = [path.relative_to(self.folder).as_posix() for path in sorted(self.folder.rglob("*")) if path.is_file()]
        names = [name for name in names if not name.rpartition("/")[2].startswith(".")]
        for name in sorted(names, key=lambda name: (name in self.grows, name)):
            self.place.put(name, (self.folder / name).read_bytes())
        for name in self.grows:
            self.place.remove(self.place.names(f"{name}.parts/"))

    def _warn(self, error: OutputError | StoreSilent) -> None:
        if not self._warned:
            self._warned = True
            self.say(f"{error}; the run goes on, and what it writes waits in {self.folder}")


def brought_back(place: Place, folder: Path, *, grows: Iterable[str]) -> None:
    """Copy what is at a place into a folder, where the folder has less: of a file that grows, what is longest."""
    names = place.names()
    for name in (name for name in names if ".parts/" not in name and name not in grows):
        if not (folder / name).exists():
            _write(folder / name, place.read(name) or b"")
    for name in grows:
        whole = place.read(name) or b"" if name in names else b""
        parts = _joined(place, [part for part in names if part.startswith(f"{name}.parts/")])
        longest = max(whole, parts, key=len)
        if len(longest) > len(_bytes(folder / name, 0, -1)):
            _write(folder / name, longest)


def _joined(place: Place, parts: Iterable[str]) -> bytes:
    data = b""
    for part in parts:
        match = _PART.fullmatch(part.rpartition("/")[2])
        if match is None or int(match[1]) != len(data):
            break
        data += place.read(part) or b""
    return data


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _bytes(path: Path, at: int, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            file.seek(at)
            return file.read(most)
    except FileNotFoundError:
        return b""
