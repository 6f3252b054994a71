"""``gsstream bench render``: forward and backward of renderers, over sizes, tile shares and threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.errors import GsstreamError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.discovery.catalog import Catalog
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render import backward as known
from gsstream.parts.render.session import RenderOutput
from gsstream_lab.bench.native import NativeBench, find_native, measure_peaks
from gsstream_lab.bench.roofline import (
    Footprints,
    Peak,
    central_tiles,
    footprints,
    live_pairs,
    pixels_of,
    roofline_ms,
)
from gsstream_lab.bench.scene import arc_rig, make_gaussians, synthetic_points
from gsstream_lab.bench.timing import Progress, Steps, interleaved, torch_threads
from gsstream_lab.jobs.machine import machine_facts

SCHEMA = "gsstream-bench-render-1"
#: The reference renderer is run where Gaussians x pixels stay below this; nothing is extrapolated beyond.
REFERENCE_LIMIT = 40_000_000


@dataclass(frozen=True, slots=True)
class Size:
    """Gaussians and image size in pixels."""

    gaussians: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.gaussians / 1000:g}k {self.width}x{self.height}"


@dataclass(frozen=True)
class RenderPlan:
    """What is measured."""

    sizes: tuple[Size, ...]
    shares: tuple[float, ...]  # of tiles that are drawn, (0, 1]
    threads: tuple[int, ...]
    renderers: tuple[str, ...]  # names of renderer parts
    #: repetitions, warm_up: rounds that count, and rounds before them.
    repetitions: int
    warm_up: int
    seed: int = 0


@dataclass
class _Scene:
    """One size: scene, camera and what was counted in it."""

    size: Size
    gaussians: Gaussians[FloatArray]
    camera: Cameras
    prints: Footprints
    pairs: IntArray
    v_image: FloatArray
    masks: dict[float, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Case:
    facts: Mapping[str, Any]
    steps: Steps
    statistics: Any = None


def bench_render(plan: RenderPlan, catalog: Catalog, progress: Progress) -> dict[str, Any]:
    """Measure everything in the plan; plain JSON values."""
    machine, skipped = machine_facts(), []
    natives = {name: find_native(name) for name in plan.renderers}
    measuring = next((native for native in natives.values() if native is not None), None)
    progress("peaks of the machine")
    peaks = measure_peaks(measuring, plan.threads, {})
    parts: dict[str, Renderer] = {}
    for name in plan.renderers:
        try:
            cls = catalog.resolve("renderer", name)
            parts[name] = cls(cls.Config())
        except GsstreamError as error:
            skipped.append({"renderer": name, "size": "all", "why": str(error)})
    scenes, results = [], []
    for number, size in enumerate(plan.sizes, 1):
        progress(f"size {number} of {len(plan.sizes)}: {size}, making and counting the scene")
        scene = _scene(plan, size)
        scenes.append(_scene_facts(scene))
        cases = []
        for name, part in parts.items():
            if name == "reference" and size.gaussians * size.width * size.height > REFERENCE_LIMIT:
                skipped.append({"renderer": name, "size": str(size), "why": "too slow here, and not extrapolated"})
                continue
            cases += _cases(plan, scene, name, part=part, native=natives[name])
        for threads in plan.threads:
            progress(f"size {number} of {len(plan.sizes)}: {size}, {threads} threads, {len(cases)} cases")
            results += _timed(plan, cases, threads, natives)
        peaks = measure_peaks(measuring, plan.threads, peaks)
    for result in results:
        _add_floor(result, peaks.get(result["threads"]))
    return {
        "schema": SCHEMA,
        "machine": {**machine, "isa": measuring.instruction_set() if measuring else None},
        "settings": {"seed": plan.seed, "repetitions": plan.repetitions, "warm_up": plan.warm_up},
        "peaks": [
            {"threads": p.threads, "gflops": p.gflops, "gbytes_per_second": p.gbytes_per_second} for p in peaks.values()
        ],
        "scenes": scenes,
        "cases": results,
        "skipped": skipped,
    }


def _scene(plan: RenderPlan, size: Size) -> _Scene:
    gaussians = make_gaussians(synthetic_points(size.gaussians, plan.seed), plan.seed)
    camera = arc_rig(1, size.width, size.height)
    prints = footprints(gaussians, camera)
    upstream = Rng(plan.seed).numpy("bench gradient").normal(size=(size.height, size.width, 3)).astype(np.float32)
    scene = _Scene(
        size=size,
        gaussians=gaussians,
        camera=camera,
        prints=prints,
        pairs=live_pairs(prints),
        v_image=upstream / np.float32(upstream.size),
    )
    scene.masks = {share: central_tiles(size.width, size.height, share) for share in plan.shares}
    return scene


def _scene_facts(scene: _Scene) -> dict[str, Any]:
    size = scene.size
    return {
        "gaussians": size.gaussians,
        "width": size.width,
        "height": size.height,
        "visible": int(scene.prints.visible.sum()),
        "live_pairs": int(scene.pairs.sum()),
    }


def _cases(plan: RenderPlan, scene: _Scene, name: str, part: Renderer, native: NativeBench | None) -> list[_Case]:
    """All shares, on both paths and both levels, of one renderer at one size."""
    cases = []
    for share in plan.shares:
        whole = share >= 1
        mask = None if whole else scene.masks[share]
        if name == "reference" and not whole:
            continue  # the reference knows no tiles: it would draw the whole image again
        for path in ("all rows",) if whole else ("all rows", "active rows"):
            active = None if path == "all rows" else scene.prints.in_tiles(scene.masks[share])
            if active is not None and not len(active):
                continue
            facts = _facts(scene, name, share, path=path, active=active)
            cases.append(_Case({**facts, "level": "part"}, _part_steps(scene, part, mask, active)))
            if native is not None:
                kernel = _kernel(scene, native, mask, active)
                steps = Steps({"forward": kernel.forward, "backward": kernel.backward})
                cases.append(_Case({**facts, "level": "kernel"}, steps, kernel.statistics))
    return cases


def _facts(scene: _Scene, name: str, share: float, path: str, active: IntArray | None) -> dict[str, Any]:
    size, mask = scene.size, scene.masks[share]
    inside = pixels_of(mask, size.width, size.height)
    return {
        "renderer": name,
        "gaussians": size.gaussians,
        "width": size.width,
        "height": size.height,
        "share": share,
        "tiles": int(mask.sum()),
        "path": path,
        "rows": size.gaussians if active is None else len(active),
        "drawn": int(scene.prints.visible.sum()) if share >= 1 else len(scene.prints.in_tiles(mask)),
        "live_pairs": int(scene.pairs[inside].sum()),
        "pixels": int(inside.sum()),
        "floats": 11 + 3 * (scene.gaussians.shN.shape[1] + 1),
    }


def _kernel(scene: _Scene, native: NativeBench, mask: Any, active: IntArray | None) -> Any:
    arrays = tuple(value for _, value in scene.gaussians.items())
    camera, size = scene.camera, scene.size
    pose = (camera.viewmats[0], camera.Ks[0], size.width, size.height, camera.near_plane)
    return native.Kernel(arrays, *pose, mask, active, scene.v_image)


def _part_steps(scene: _Scene, part: Renderer, mask: Any, active: IntArray | None) -> Steps:
    """What an iteration of the engine pays: the session's render and torch's backward through it."""
    whole = scene.gaussians.map(torch.from_numpy)
    ids = None if active is None else torch.from_numpy(active)
    tiles = None if mask is None else torch.from_numpy(mask)
    leaves = (whole if ids is None else whole.rows(ids)).map(lambda t: t.clone().requires_grad_())
    session = part.open(whole, ids, scene.camera, (0.0, 0.0, 0.0))
    upstream = torch.from_numpy(scene.v_image)
    held: list[RenderOutput] = []

    def prepare() -> None:
        held.clear()
        for name in ATTRIBUTES:
            getattr(leaves, name).grad = None

    def forward() -> None:
        held.append(session.render(0, leaves, tile_mask=tiles))

    def backward() -> None:
        known.backward([held[-1].image], [upstream])

    return Steps({"forward": forward, "backward": backward}, prepare)


def _timed(
    plan: RenderPlan, cases: Sequence[_Case], threads: int, natives: Mapping[str, NativeBench | None]
) -> list[dict[str, Any]]:
    known = [(native, native.num_threads()) for native in natives.values() if native is not None]
    for native, _ in known:
        native.set_num_threads(threads)
    try:
        with torch_threads(threads):
            timings = interleaved([case.steps for case in cases], plan.repetitions, plan.warm_up)
    finally:
        for native, before in known:
            native.set_num_threads(before)
    results = []
    for case, timing in zip(cases, timings, strict=True):
        forward, backward = timing["forward"], timing["backward"]
        times = {"forward_ms": forward, "backward_ms": backward, "total_ms": forward + backward}
        counts = dict(case.statistics()) if case.statistics else None
        found = {name: timing.to_json() for name, timing in times.items()}
        results.append({**case.facts, "threads": threads, **found, "statistics": counts})
    return results


def _add_floor(result: dict[str, Any], peak: Peak | None) -> None:
    """The floor of the case and the distance to it, from the best peaks seen during the whole benchmark.

    ``ratio_cpu`` takes the processor time, spread evenly over the threads, in place of the time that passed: what the
    ratio would be on a machine with nothing else to do.
    """
    if peak is None:
        result |= {"roofline_ms": None, "ratio": None, "ratio_cpu": None}
        return
    keys = {"pairs": "live_pairs", "visible": "drawn", "rows": "rows", "pixels": "pixels", "floats": "floats"}
    floor = sum(roofline_ms(peak, **{key: result[name] for key, name in keys.items()}))
    least, work = result["total_ms"]["min"], result["total_ms"]["cpu"] / result["threads"]
    result |= {"roofline_ms": round(floor, 5), "ratio": round(least / floor, 3), "ratio_cpu": round(work / floor, 3)}
