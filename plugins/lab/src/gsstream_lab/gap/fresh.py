"""Fresh reconstructions of single frames: what the same cameras allow at that instant, by the recipe's own frame 0."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.errors import InputError
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.budget.memory import limit_memory
from gsstream.engine.run.encoder import Callbacks, Encoder
from gsstream.engine.run.output import write_whole
from gsstream.input.recordings.base import Source, SourceInfo, check_index
from gsstream.packet import EncodedPacket, StreamMeta, StreamWriter
from gsstream.recipe.model import Recipe, first_frame_settings

#: Called with (frame, iterations done, iterations in all).
Progress = Callable[[int, int, int], None]


def fresh_recipe(recipe: Recipe, epochs: int | None = None) -> Recipe:
    """Return the recipe by which a later frame is reconstructed from its own images alone.

    It is the run's own but for the seeds: the points of a recording belong to frame 0, so others are found by a plane
    sweep over the frame's images (triangulated ones stay triangulated).
    """
    first = recipe.first_frame
    changes: dict[str, object] = {} if first.points == "sfm" else {"points": "auto"}
    if epochs is not None:
        changes |= {"epochs": epochs, "max_iterations": 10**9}
    return recipe.model_copy(update={"first_frame": first.model_copy(update=changes), "frames": None})


@dataclass(frozen=True)
class FreshFrames:
    """The fresh reconstructions of one recording by one recipe, one stream file of a single packet for each frame."""

    assembly: Assembly  # assembled from :func:`fresh_recipe`
    source: Source  # the recording as the run opened it
    cache: Path  # folder that keeps them; several runs may share one, because a file's name says what it was made of

    @classmethod
    def of_run(
        cls, recipe: Recipe, source: Source, cache: Path, catalog: Catalog, epochs: int | None = None
    ) -> FreshFrames:
        """Return those of a run by its recipe."""
        assembly = assemble(fresh_recipe(recipe, epochs), catalog)
        return cls(limit_memory(assembly, source), source, cache)

    @property
    def epochs(self) -> int:
        """Most passes that a reconstruction makes over its training images."""
        first = self.assembly.recipe.first_frame
        return min(first.epochs, -(-first.max_iterations // max(1, len(self.source.info.train))))

    def file(self, frame: int) -> Path:
        """Return where the reconstruction of a frame lies, or will."""
        recipe = self.assembly.recipe
        made_of = [self.source.info.uri, self.source.info.train.ids, recipe.seed, first_frame_settings(recipe)]
        text = json.dumps(made_of, sort_keys=True, separators=(",", ":"))
        return self.cache / f"{hashlib.sha256(text.encode()).hexdigest()[:12]}-{frame:06d}.gss"

    def make(self, frame: int, progress: Progress = lambda *_: None) -> bool:
        """Reconstruct a frame, unless the cache has it; return whether it was made now.

        Raises SourceError for a frame that the recording does not have; the file appears complete or not at all.
        """
        check_index(self.source.info, frame)
        path = self.file(frame)
        if path.is_file():
            return False
        packets: list[EncodedPacket] = []
        listeners = Callbacks(packet=packets.append, progress=lambda done, total, *_: progress(frame, done, total))
        Encoder(self.assembly, self.source.info, callbacks=listeners).encode(self.source.frame(frame, "train"))
        self.cache.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        part.unlink(missing_ok=True)
        try:
            with StreamWriter.open(part) as writer:
                writer.append(packets[0])
            write_whole(path, part.read_bytes())
        finally:
            part.unlink(missing_ok=True)
        return True


def check_cameras(meta: StreamMeta, info: SourceInfo) -> None:
    """Raise InputError when a recording's cameras are not those of a stream, or when none of them is a test camera."""
    if len(meta.test) == 0:
        raise InputError("the stream has no test cameras, so there is nothing to compare with (data.test_cameras)")
    for split, theirs, here in (("training", meta.train, info.train), ("test", meta.test, info.test)):
        same = theirs.ids == here.ids and (theirs.width, theirs.height) == (here.width, here.height)
        if not same or not np.allclose(theirs.viewmats, here.viewmats, atol=1e-6):
            raise InputError(
                f"the recording {info.name!r} is not the one of the stream: expected {split} cameras "
                f"{list(theirs.ids)} at {theirs.width} x {theirs.height}, got {list(here.ids)} at {here.width} x "
                f"{here.height}; name the recording of the run with --source"
            )
