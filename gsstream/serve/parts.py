"""A live stream as files: parts that never change and a manifest that rolls, for any web server or CDN."""

from __future__ import annotations

import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gsstream.core.errors import OutputError, PacketError
from gsstream.packet import FORMAT_VERSION, Entry, PacketKind
from gsstream.serve.follow import Follower
from gsstream.serve.package import MANIFEST, SEGMENTS, player_files
from gsstream.store.place import Place
from gsstream.store.troubles import StoreSilent

PARTS = "parts"
#: Seconds of a part, which are also those between two manifests.
PART = 1.0
#: Seconds that a part which no manifest names stays: a viewer may hold a manifest that is older.
KEPT = 60.0
#: What HTTP says of each: a part never changes under its name, a manifest is looked at once a second for all viewers.
FOR_EVER, FOR_A_SECOND = "public, max-age=31536000, immutable", "public, max-age=1"
#: The same of a recorded page: its manifest, and its player.
FOR_SECONDS, FOR_MINUTES = "public, max-age=5", "public, max-age=300"
_NAME = re.compile(rf"{PARTS}/\d{{6,}}-[0-9a-f]{{12}}\.gss")


class LivePackage:
    """Writes what a follower sees to a place. A part is a file header with whole packets; a key packet begins one.

    The manifest lists the parts since the last key packet but one: whoever comes begins at the newest, and whoever
    watches finds what follows. :meth:`look` does it once; nothing is read before.
    """

    def __init__(self, follower: Follower, place: Place) -> None:
        self.follower, self.place = follower, place
        self._generation, self._count = 0, 0
        self._parts: list[dict[str, Any]] = []
        self._gone: list[tuple[float, str]] = []
        self._told = ""

    def write_page(self) -> None:
        """Put the player there, and take away the parts of an earlier stream. Raises OutputError."""
        self._gone = [(time.monotonic(), name) for name in self.place.names(f"{PARTS}/") if _NAME.fullmatch(name)]
        for name, data in player_files():
            self.place.put(name, data, kept=FOR_MINUTES)

    def look(self) -> bool:
        """Write the packets that came since the last call, then the manifest. Returns whether the stream has ended.

        Raises OutputError; what was not written is written by the next call.
        """
        stream = self.follower
        stream.look()
        if stream.generation != self._generation:
            self._drop(len(self._parts))
            self._generation, self._count = stream.generation, 0
        for run in self._runs():
            self._put(run)
            self._count += len(run)
        keys = [place for place, part in enumerate(self._parts) if part["key"]]
        self._drop(keys[-2] if len(keys) > 1 else 0)
        state = stream.state()
        manifest = {
            "format": f"gsstream {FORMAT_VERSION}",
            "seconds": PART,
            "state": state.name,
            "detail": state.detail,
            "parts": self._parts,
        }
        text = json.dumps(manifest, indent=1) + "\n"
        if text != self._told and (self._parts or not self._told):
            self.place.put(MANIFEST, text.encode(), kept=FOR_A_SECOND)
            self._told = text
        self._remove()
        return state.name == "ended"

    def run(self, stop: threading.Event, say: Callable[[str], object]) -> None:
        """Write until the stream has ended or ``stop`` is set. A store that does not answer is told once."""
        told = False
        while not stop.is_set():
            began = time.monotonic()
            try:
                if self.look():
                    return
                told = False
            except StoreSilent as error:
                if not told:
                    say(f"{error}; the stream waits for it in its file")
                told = True
            stop.wait(max(0.0, began + PART - time.monotonic()))

    def _runs(self) -> Iterator[list[Entry]]:
        """The packets that are not written yet, in the runs that become parts."""
        stream = self.follower
        run: list[Entry] = []
        for entry in stream.entries[self._count : stream.count]:
            if entry.kind == PacketKind.KEY and run:
                yield run
                run = []
            run.append(entry)
        if run:
            yield run

    def _put(self, run: list[Entry]) -> None:
        try:
            data = self.follower.header() + b"".join(map(self.follower.read, run))
        except (PacketError, OSError) as error:
            raise OutputError(f"{self.follower.path}: {error}") from error
        name = f"{PARTS}/{run[0].frame:06d}-{hashlib.sha256(data).hexdigest()[:12]}.gss"
        self.place.put(name, data, kept=FOR_EVER)
        frames = [run[0].frame, run[-1].frame]
        self._parts.append({"file": name, "frames": frames, "bytes": len(data), "key": run[0].kind == PacketKind.KEY})

    def _drop(self, count: int) -> None:
        """Name the first parts no longer."""
        self._gone += [(time.monotonic(), part["file"]) for part in self._parts[:count]]
        del self._parts[:count]

    def _remove(self) -> None:
        old = [name for at, name in self._gone if time.monotonic() - at > KEPT]
        if old:
            kept = {part["file"] for part in self._parts}
            self.place.remove(name for name in old if name not in kept)
            self._gone = [(at, name) for at, name in self._gone if name not in old]


def bring_page(folder: Path, place: Place) -> int:
    """Put a recorded page to a place, with what HTTP is to say of each file, the manifest last; return their number.

    Files of an earlier page stay: a viewer may still watch it. Raises OutputError.
    """
    names = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
    for name in sorted(names, key=lambda name: (name == MANIFEST, name)):
        kept = FOR_EVER if name.startswith(f"{SEGMENTS}/") else FOR_SECONDS if name == MANIFEST else FOR_MINUTES
        place.put(name, (folder / name).read_bytes(), kept=kept)
    return len(names)
