"""Random calls of the compiled kernels, most of them wrong in some way: what ``tools.sanitise`` runs under sanitisers.

Usage: python -m tools.random_calls COUNT SEED

Refusals are the kernels' right; whatever else they raise, and pictures that are not finite, end the program.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable

import numpy as np
from gsstream_cpu_render.arrays import SplatArrays, mask_shape
from gsstream_cpu_render.loss import photometric_loss
from gsstream_cpu_render.rasterizer import NumpyRasterizer, render_numpy

from gsstream.core.errors import InputError

#: Values that numbers are replaced with.
HOSTILE = (np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-38, 0.0, 88.0, -88.0, 1e15)
#: What an array is turned into before it is given away.
SHAPES: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    lambda a: a.astype(np.float64),
    lambda a: a.astype(np.float16),
    np.asfortranarray,
    lambda a: a[::2],
    lambda a: a[:-1],
    lambda a: a[..., None],
    lambda a: a[..., :0],
    lambda a: np.repeat(a, 2, 0)[::2],
)


def scene(rng: np.random.Generator) -> SplatArrays:
    """0 to 300 Gaussians; in one call of two a few numbers are hostile, in one of four an array is of another form."""
    count, harmonics = int(rng.integers(0, 301)), int(rng.choice([0, 3, 8, 15]))
    shapes = (count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, harmonics, 3)
    arrays = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    arrays[0][:, 2] += 3
    arrays[2] -= rng.uniform(-1, 4)
    if count and rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            array = arrays[rng.integers(len(arrays))]
            if array.size:
                array.flat[rng.integers(array.size)] = rng.choice(HOSTILE)
    if rng.random() < 0.25:
        place = int(rng.integers(len(arrays)))
        arrays[place] = SHAPES[rng.integers(len(SHAPES))](arrays[place])
    return SplatArrays(*arrays)


def view(rng: np.random.Generator) -> NumpyRasterizer:
    """A rasteriser of 1 to 100 pixels a side; one in ten has a bad camera."""
    width, height = (int(side) for side in rng.integers(1, 101, 2))
    focal = float(rng.uniform(5, 200))
    viewmat, K = np.eye(4), np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    if rng.random() < 0.1:
        (viewmat if rng.random() < 0.5 else K).flat[rng.integers(9)] = rng.choice(HOSTILE)
    return NumpyRasterizer(viewmat, K, width, height, (0.1, 0.2, 0.3), float(rng.choice([1e-3, 0.01, 1.0, 0.0])))


def mask(rng: np.random.Generator, one: NumpyRasterizer) -> np.ndarray | None:
    """Some tiles, or all; one in ten is of another size."""
    if rng.random() < 0.5:
        return None
    rows, columns = mask_shape(one.width, one.height)
    return rng.random((rows + int(rng.random() < 0.1), columns)) < 0.6


def call(rng: np.random.Generator) -> None:
    """Render a scene whole, then in parts, and differentiate; every step with its own chance to be wrong."""
    one, splats = view(rng), scene(rng)
    if rng.random() < 0.2:
        one.limit_memory(int(rng.integers(1, 200_000)), len(splats.means))
    image, transmittance = one.forward(splats, tile_mask=mask(rng, one))
    if not np.isfinite(image).all():
        raise AssertionError("a picture that is not finite")
    upstream = rng.normal(size=image.shape).astype(np.float32)
    if rng.random() < 0.5:
        one.backward(upstream if rng.random() < 0.9 else upstream[:-1], compact=bool(rng.random() < 0.5))
    count = len(splats.means)
    ids = np.flatnonzero(rng.random(count + int(rng.random() < 0.1)) < 0.3).astype(np.uint32)
    if rng.random() < 0.05:
        ids = ids[::-1]
    one.freeze(mask(rng, one), ids)
    rows = SplatArrays(*(np.ascontiguousarray(array[ids[ids < count]]) for array in splats))
    one.forward_active(rows, touched_only=bool(rng.random() < 0.5))
    if rng.random() < 0.5:
        one.backward_active(upstream)
    one.update(ids, rows, image, transmittance)
    one.forward_cached(tile_mask=mask(rng, one))
    photometric_loss(image, rng.random(image.shape, np.float32))
    arrays = [np.asarray(array, np.float32) for array in splats]
    render_numpy(arrays, np.eye(4), np.diag([50.0, 50.0, 1.0]), one.width, one.height, max_memory=1 << 24)


def main(argv: list[str] | None = None) -> None:
    """Make the calls; print how many passed and why the others were refused."""
    count, seed = (int(word) for word in (sys.argv[1:] if argv is None else argv))
    outcome: Counter[str] = Counter()
    for number in range(count):
        try:
            call(np.random.default_rng([seed, number]))
            outcome["passed"] += 1
        except (InputError, MemoryError) as error:
            outcome[type(error).__name__] += 1
        except BaseException:
            print(f"call {number} of seed {seed}", file=sys.stderr)
            raise
    print(", ".join(f"{name} {number}" for name, number in sorted(outcome.items())))


if __name__ == "__main__":
    main()
