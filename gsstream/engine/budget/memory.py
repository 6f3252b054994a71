"""A memory budget before the run: what it needs at least, how many Gaussians and how large a cache fit.

Constants, not what the process has now, so that a resumed run computes the same limits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gsstream.core.errors import InputError
from gsstream.core.picture_size import COMPACT_PIXELS
from gsstream.engine.assembly.assemble import Assembly
from gsstream.input.recordings.base import Source

#: Interpreter, torch, the renderer and the engine with everything a run imports (measured).
PROCESS = 310_000_000
#: Images of each training camera that wait in memory, as the source hands them over: of the frame, of the one before,
#: and of two that are read ahead.
WAITING = 4
#: Images of float32 that are made for one camera at a time: renders, gradients, maps of the loss, and the temporary
#: images of every phase (measured at widths of 320 and 1352).
WORKING = 8
#: Bytes of a Gaussian with its gradients and moments in frame 0; bytes of the copies that a later frame makes of a
#: Gaussian, when there are caches.
BYTES_PER_GAUSSIAN, BYTES_PER_GAUSSIAN_LATER = 1_700, 700
#: Share of the memory beside the images that Gaussians get; caches get the rest (250 bytes per camera and Gaussian).
FOR_GAUSSIANS = 0.6
#: With fewer Gaussians than this a scene is not worth encoding.
MIN_GAUSSIANS = 1_000


def min_memory(source: Source) -> int:
    """Return how many bytes a run of this recording needs with the least number of Gaussians."""
    return _fixed(source) + round(MIN_GAUSSIANS * BYTES_PER_GAUSSIAN / FOR_GAUSSIANS)


def limit_memory(assembly: Assembly, source: Source) -> Assembly:
    """Return the parts with so few Gaussians and so small a cache of the renderer that the memory budget holds.

    Raises InputError when the budget is below what any run of this recording needs.
    """
    memory = assembly.recipe.budget.memory
    if memory is None:
        return assembly
    least, train = min_memory(source), source.info.train
    if memory < least:
        raise InputError(
            f"budget.memory: {memory / 1e6:.0f} MB, but a run of this recording needs at least "
            f"{least / 1e6:.0f} MB ({PROCESS / 1e6:.0f} MB for the process, the rest for "
            f"{len(train)} training cameras of {train.width} x {train.height} pixels and "
            f"{MIN_GAUSSIANS} Gaussians); give more, or lower --scale"
        )
    free, first = memory - _fixed(source), assembly.recipe.first_frame
    most = min(first.max_gaussians, round(FOR_GAUSSIANS * free) // BYTES_PER_GAUSSIAN)
    recipe = assembly.recipe.model_copy(update={"first_frame": first.model_copy(update={"max_gaussians": most})})
    assembly = replace(assembly, recipe=recipe)
    return _with_cache(assembly, (free - most * BYTES_PER_GAUSSIAN_LATER) / 1e6)


def _with_cache(assembly: Assembly, megabytes: float) -> Assembly:
    """The renderer with at most this much cache, where it has such a setting."""
    config = assembly.renderer.config
    if "cache_mb" not in type(config).model_fields:
        return assembly
    given = getattr(config, "cache_mb")  # noqa: B009  # a setting of some renderers alone
    cache = round(megabytes if given is None else min(megabytes, given), 1)
    config = type(config)(**{**config.model_dump(), "cache_mb": cache})
    ref = assembly.recipe.renderer.model_copy(update={"params": config.model_dump(mode="json")})
    recipe = assembly.recipe.model_copy(update={"renderer": ref})
    renderer: Any = type(assembly.part("renderer"))(config)
    return replace(assembly, recipe=recipe, renderer=renderer)


def waiting_memory(source: Source) -> int:
    """Return how many bytes the training images take that wait at one time, as the source hands them over."""
    return WAITING * len(source.info.train) * _pixels(source) * (3 if source.stores_bytes else 12)


def _fixed(source: Source) -> int:
    train, test = source.info.train, source.info.test
    # Statistics of frame 0, and a frame of float32 that is being read beside those that wait.
    more = (1 if _pixels(source) >= COMPACT_PIXELS else 2) + (0 if source.stores_bytes else 1)
    return PROCESS + waiting_memory(source) + (more * len(train) + 4 * len(test) + WORKING) * 12 * _pixels(source)


def _pixels(source: Source) -> int:
    """Pixels of one image."""
    return source.info.train.width * source.info.train.height
