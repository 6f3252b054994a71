"""Where the results of a run go: a folder, or an address to which they are brought while it works."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gsstream.core.errors import OutputError
from gsstream.core.names import last_part
from gsstream.store.address import is_address

if TYPE_CHECKING:
    from gsstream.store.place import Place

#: Files of a run to which is only appended.
GROWS = ("stream.gss", "metrics.jsonl")


class Results:
    """The folder that a run writes: of an address, one of the cache, which goes when all was brought there.

    Raises InputError for an address that cannot be one, or without what speaks to its store.
    """

    def __init__(self, out: str) -> None:
        self.folder = Path(out)
        self._place: Place | None = None
        if is_address(out):
            from gsstream.store.cache import cache_folder
            from gsstream.store.place import place_at

            self._place = place_at(out)
            name = hashlib.sha256(self._place.address.encode()).hexdigest()[:24]
            self._entry = cache_folder() / "runs" / name
            self.folder = self._entry / (last_part(self._place.address) or "run")

    @contextmanager
    def brought(self, *, resume: bool, overwrite: bool, say: Callable[[str], None]) -> Iterator[None]:
        """Bring what is written while this is open to the address, and in the end everything.

        Raises OutputError when the address holds a run that is neither continued nor replaced, or takes no files.
        """
        if self._place is None:
            yield
            return
        from gsstream.store.cache import Lock
        from gsstream.store.mirror import Mirror

        try:
            lock = Lock(self._entry)
        except OSError as error:
            raise OutputError(f"the cache {self._entry} cannot be used: {error.strerror or error}") from error
        try:
            if not lock.if_unused():
                raise OutputError(f"another run writes to {self._place.address}: wait for it, or take another --out")
            self._prepare(resume=resume, overwrite=overwrite)
            with Mirror(self.folder, self._place, grows=GROWS, say=say):
                yield
            say(f"{self._place.address} has the stream and all that belongs to it")
            shutil.rmtree(self._entry, ignore_errors=True)
        finally:
            lock.close()

    def _prepare(self, *, resume: bool, overwrite: bool) -> None:
        from gsstream.engine.run.output import MADE_FILES, RUN_FILES
        from gsstream.store.mirror import brought_back

        assert self._place is not None
        known = {*RUN_FILES, *MADE_FILES}
        there = [name for name in self._place.names() if name in known or name.partition(".parts/")[0] in GROWS]
        here = any((self.folder / name).exists() for name in RUN_FILES)
        if (there or here) and not (resume or overwrite):
            raise OutputError(
                f"{self._place.address} already holds a run: continue it with --resume, replace it with --overwrite, "
                "or choose another --out"
            )
        if overwrite:
            self._place.remove(there)
        elif resume:
            brought_back(self._place, self.folder, grows=GROWS)
