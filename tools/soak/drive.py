"""One case of a soak: encode it here, play the file with a fresh player, compare bit by bit, look at every number."""

from __future__ import annotations

import hashlib
import json
import math
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsstream.core.errors import ComponentError, InputError, PluginUnavailable, ShapeError
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.engine.run.recording import open_recording
from gsstream.engine.run.run_frame import RepeatedFrameWarning, SkippedWorkWarning
from gsstream.engine.run.session import METRICS, STREAM, RunListener, run
from gsstream.packet import PlayerState
from gsstream.player.playback import Playback
from gsstream.player.render import find_renderer, render
from gsstream.recipe.load import resolve_recipe
from tools.soak.cases import Case

Status = Literal["ok", "refused", "failed"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a case came to."""

    #: Ok; refused: recipe and recording do not go together, and a message says so before anything is encoded; failed:
    #: anything else.
    status: Status
    problem: str = ""  # message of the refusal; of a failure what went wrong, with its traceback
    frames: int = 0  # frames encoded, played and compared
    gaussians: int = 0  # in the last scene
    kinds: dict[str, int] | None = None  # packet kind -> number
    bytes: int = 0  # size of the stream
    seconds: float = 0.0  # wall time

    def record(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)


class Fault(Exception):
    """Something that must never be so: encoder and player differ, or a number is not finite."""


def run_case(case: Case, catalog: Catalog, out: Path) -> Outcome:
    """Encode and check one case in the empty folder ``out``. Never raises but for KeyboardInterrupt and its like."""
    started = time.perf_counter()
    try:
        parts = assemble(resolve_recipe(case.method, catalog.recipe_path, (), case.overrides), catalog)
        open_recording(case.source, parts.recipe, catalog).close()
    except (InputError, PluginUnavailable) as error:
        return Outcome("refused", f"{type(error).__name__}: {error}")
    digests: list[str] = []
    try:
        found = _encode_and_check(case, parts, catalog, out=out, digests=digests)
    except Exception as error:  # whatever it is, the soak goes on and its record says so
        problem = f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        asked = isinstance(error, InputError) and not isinstance(error, ShapeError) and not digests
        return Outcome("refused" if asked else "failed", problem, seconds=time.perf_counter() - started)
    return Outcome("ok", seconds=time.perf_counter() - started, **found)


def _encode_and_check(case: Case, parts: Assembly, catalog: Catalog, out: Path, digests: list[str]) -> dict[str, Any]:
    kinds: dict[str, int] = {}

    class Witness(RunListener):
        def after(self, step: EncodedFrame) -> Mapping[str, Any]:
            digests.append(digest(step.state.player))
            kinds[step.status] = kinds.get(step.status, 0) + 1
            return {}

    source = open_recording(case.source, parts.recipe, catalog)
    try:
        with warnings.catch_warnings():
            for failed in (RepeatedFrameWarning, SkippedWorkWarning):
                warnings.simplefilter("error", failed)
            run(parts, source, out, quiet=True, listener=Witness())
    except (RepeatedFrameWarning, SkippedWorkWarning) as error:
        raise ComponentError(
            str(error), slot="any", part="any", distribution="any", frame=len(digests), iteration=None
        ) from error
    finally:
        source.close()
    for number, line in enumerate((out / METRICS).read_text(encoding="utf-8").splitlines()):
        _finite_numbers(json.loads(line), f"metrics of frame {number}")
    gaussians = _play(out / STREAM, digests, case.index)
    size = (out / STREAM).stat().st_size
    return {"frames": len(digests), "gaussians": gaussians, "kinds": kinds, "bytes": size}


def _play(stream: Path, digests: list[str], salt: int) -> int:
    """Check all frames in order, then four in random order in a second player; return N of the last frame."""
    with Playback(stream) as playback:
        if len(playback) != len(digests):
            raise Fault(f"encoded {len(digests)} frames, the player finds {len(playback)}")
        for frame, theirs in enumerate(digests):
            state = playback.player_state(frame)
            _same(digest(state), theirs, frame, "in order")
            for name, value in state.gaussians.items():
                _finite(value, f"{name} of frame {frame}")
        last = state.gaussians
        for camera in range(len(playback.cameras("test"))):
            shown = render(
                last, playback.cameras("test"), camera, background=playback.meta.background, renderer=find_renderer()
            )
            _finite(shown, f"picture of test camera {camera}")
    with Playback(stream) as playback:
        for frame in np.random.default_rng(salt).permutation(len(digests))[:4].tolist():
            _same(digest(playback.player_state(frame)), digests[frame], frame, "after a jump")
    return len(last)


def digest(state: PlayerState) -> str:
    """SHA-256 of all that a player has: scene, layout, decoders."""
    layout = state.layout
    arrays = [*(value for _, value in state.gaussians.items()), layout.node_counts, layout.unit_of]
    arrays += [layout.units, *(state.decoders[name] for name in sorted(state.decoders))]
    sums = hashlib.sha256(" ".join(sorted(state.decoders)).encode())
    for array in arrays:
        sums.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return sums.hexdigest()


def _same(ours: str, theirs: str, frame: int, how: str) -> None:
    if ours != theirs:
        raise Fault(f"frame {frame}, played {how}, differs from the encoder's decoded state")


def _finite(value: np.ndarray[Any, Any], what: str) -> None:
    bad = np.argwhere(~np.isfinite(value))
    if len(bad):
        raise Fault(f"{what}: {value[tuple(bad[0])]} at {bad[0].tolist()} ({len(bad)} of {value.size} not finite)")


def _finite_numbers(value: Any, where: str) -> None:
    for path, number in _numbers(value, where):
        if not math.isfinite(number):
            raise Fault(f"{path}: {number}")


def _numbers(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{path}, {key}")
    elif isinstance(value, list):
        for inner in value:
            yield from _numbers(inner, path)
    elif isinstance(value, int | float):
        yield path, float(value)
