"""Encode from Python: frames in, packets out, no folder and no command line.

::

    from gsstream.encode import encode, open_recording

    with open_recording("demo") as source:
        for frame in encode("s2gs-edge", source, {"frames": 3}, out="demo.gss"):
            print(frame.status, len(frame.packet.data))

:func:`encoder_for` gives the encoder alone, for frames in a loop of your own.
A method is also composed: parts that are given, live or by name, take the places of those in the recipe of a method.
That of ``dense`` groups nothing, moves nothing, opens every gate and corrects every Gaussian::

    from gsstream.parts.motion.rigid import Rigid
    from gsstream_s2gs.octree import StreamingOctree

    motion = Rigid(Rigid.Config(epochs=3))
    encoder = encoder_for("dense", source, structure=StreamingOctree(), motion=motion, confidence="view-gradient")

A whole method is given as ``streaming_method``. Classes of live parts need not be declared by a plugin.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, Unpack

from gsstream.core.cameras import Cameras as Cameras
from gsstream.core.errors import EndOfRecording, InputError
from gsstream.core.frame import Frame as Frame
from gsstream.core.world import rig_similarity, snap_cameras
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import Assembly as Assembly
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.slots import Parts as Parts
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Callbacks as Callbacks
from gsstream.engine.run.encoder import EncodedFrame as EncodedFrame
from gsstream.engine.run.encoder import Encoder as Encoder
from gsstream.engine.run.recording import open_recording as _open
from gsstream.input.recordings.base import Source as Source
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.packet import StreamWriter as StreamWriter
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import Recipe as Recipe

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog

__all__ = [
    "Assembly", "Callbacks", "Cameras", "EncodedFrame", "Encoder", "Frame", "Parts", "Recipe", "Source",
    "StreamWriter", "encode", "encoder_for", "encoder_for_rig", "open_recording", "recipe_for", "to_rig_coordinates",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def recipe_for(method: str, settings: Mapping[str, Any] | None = None) -> Recipe:
    """Return the recipe of a method.

    Arguments:
        method: a name of ``gsstream methods``.
        settings: key -> value, as ``--set`` takes them: ``{"stream.epochs": 6}``.

    Raises UnknownName or RecipeError as ``gsstream run`` does.
    """
    return _recipe(method, settings, load_catalog())


def _recipe(method: str, settings: Mapping[str, Any] | None, catalog: Catalog) -> Recipe:
    changes = [("settings", f"{key}={value}") for key, value in (settings or {}).items()]
    return resolve_recipe(method, catalog.recipe_path, (), changes).recipe


@contextmanager
def open_recording(uri: str, recipe: Recipe | None = None) -> Iterator[Source]:
    """Open a recording, and close it at the end of the block.

    Its cameras and points come in coordinates that its rig defines; ``source.info.world`` leads back to the files'.

    Arguments:
        uri: "demo", "synthetic:...", a folder: what ``--source`` takes.
        recipe: its scale and its split; None: everything as recorded.

    Raises SourceError when it cannot be read.
    """
    source = _open(uri, recipe or Recipe(), load_catalog())
    try:
        yield source
    finally:
        source.close()


def to_rig_coordinates(source: Source) -> Source:
    """Return a recording in the coordinates that its rig defines, so that units and origin of its files do not matter.

    :func:`open_recording` has done it already; a source of your own has not.

    Arguments:
        source: an open recording, in any coordinates.
    """
    return CanonicalSource(source, recording_similarity(source))


def encode(
    method: str,
    source: Source,
    settings: Mapping[str, Any] | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    listeners: Callbacks | None = None,
    **parts: Unpack[Parts],
) -> Iterator[EncodedFrame]:
    """Return an iterator that encodes a recording, and yields an :class:`EncodedFrame` for each of its frames.

    The iterator ends with the recording, or after as many frames as the setting ``frames`` says. A loop that is left
    early leaves a whole stream of the frames so far.

    Arguments:
        method: a name of ``gsstream methods``.
        source: an open recording, as for :func:`encoder_for`.
        settings: as for :func:`recipe_for`.
        out: file of the stream, which must not exist; every packet is in it before its frame is yielded. None: no file.
        listeners: as for :func:`encoder_for`.
        parts: as for :func:`encoder_for`.

    Raises what :func:`encoder_for` raises at once, and while it is iterated what :meth:`Encoder.encode` raises, and
    SourceError for a frame that cannot be read.
    """
    return _encoded(encoder_for(method, source, settings, listeners, **parts), source, out)


def _encoded(encoder: Encoder, source: Source, out: str | os.PathLike[str] | None) -> Iterator[EncodedFrame]:
    with nullcontext() if out is None else StreamWriter.open(out) as writer:
        for index in itertools.islice(itertools.count(), encoder.assembly.recipe.frames):
            if index == source.info.num_frames:  # asked each time: a recording that grows may end
                return
            try:
                frame = source.frame(index)
            except EndOfRecording:
                return
            encoded = encoder.encode(frame)
            if writer is not None:
                writer.append(encoded.packet)
            try:
                yield encoded
            except GeneratorExit:  # the loop was left: the writer ends the file as after the last frame
                return


def encoder_for(
    method: str,
    source: Source,
    settings: Mapping[str, Any] | None = None,
    listeners: Callbacks | None = None,
    **parts: Unpack[Parts],
) -> Encoder:
    """Return an encoder of a recording, before its frame 0.

    Arguments:
        method: a name of ``gsstream methods``.
        source: an open recording, of :func:`open_recording` or :func:`to_rig_coordinates`; its points seed frame 0.
        settings: as for :func:`recipe_for`.
        listeners: functions called with every packet and with the progress of frame 0.
        parts: in place of those in the method's recipe, by slot: live, or by name.

    Raises InputError for a part that does not fit its slot, and as :func:`recipe_for` does.
    """
    assembly = _assembled(method, settings, parts)

    def seeds(frame: Frame) -> Any:
        return gather_points(source, frame, assembly.recipe.first_frame, device=assembly.renderer.device)

    return Encoder(assembly, source.info, seeds, callbacks=listeners)


def encoder_for_rig(
    method: str,
    cameras: Cameras,
    *,
    fps: float = 30.0,
    settings: Mapping[str, Any] | None = None,
    name: str = "rig",
    **parts: Unpack[Parts],
) -> Encoder:
    """Return an encoder of images that come from anywhere; frame 0 is seeded by a plane sweep over them.

    The stream lies in coordinates that the rig defines: cameras of frames are taken there by
    :meth:`Encoder.with_near_plane`, and what a player shows is taken back by ``meta.world``.

    Arguments:
        method: a name of ``gsstream methods``.
        cameras: the training cameras; frames bring their images in this order.
        fps: frames per second, for players.
        settings: as for :func:`recipe_for`.
        name: what the stream says of its origin.
        parts: as for :func:`encoder_for`.
    """
    world = rig_similarity(cameras)
    info = SourceInfo(
        name=name,
        uri=f"rig:{name}",
        num_frames=None,
        fps=fps,
        train=snap_cameras(world.inverse_cameras(cameras)),
        test=cameras.select([]),
        world=world,
    )
    return Encoder(_assembled(method, settings, parts), info, transform_cameras=True)


def _assembled(method: str, settings: Mapping[str, Any] | None, parts: Parts) -> Assembly:
    """Return the assembled parts of a method's recipe; each of ``parts`` replaces the part of its slot."""
    given: dict[str, Any] = dict(parts)
    unknown = sorted(given.keys() - Parts.__annotations__.keys())
    if unknown:
        raise InputError(f"no slot is called {', '.join(unknown)}: expected some of {', '.join(Parts.__annotations__)}")
    named = {slot: part for slot, part in given.items() if isinstance(part, str)}
    live = {slot: part for slot, part in given.items() if slot not in named}
    for key in settings or {}:
        if key.partition(".")[0] in live:
            raise InputError(f"{key}: the part is given live, with settings of its own; make it with this one")
    catalog = load_catalog()
    return assemble(_recipe(method, {**named, **(settings or {})}, catalog), catalog, live=live)
