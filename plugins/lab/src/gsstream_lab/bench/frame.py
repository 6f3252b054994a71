"""``gsstream bench frame``: one frame step by phase, against the share that changes and the size of the rest.

The scene is synthetic: everything within a ball moves by a pixel between two frames, the rest stands still, both
images carry camera noise. Nothing is read from disk and frame 0 is not optimised: it is drawn from the scene itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Layout
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.run.encoder import EncodedFrame, Encoder
from gsstream.engine.state.stream_state import StreamState
from gsstream.input.recordings.base import SourceInfo
from gsstream.metrics import peak_memory_mb, psnr
from gsstream.packet import KeyState, PlayerState, StreamMeta, decode_packet, encode_key
from gsstream.parts.render.images import TILE
from gsstream.recipe.model import ComponentRef, Recipe
from gsstream_lab.bench.scene import (
    OBJECT_CENTER,
    OBJECT_RADIUS,
    OBJECT_ROOM,
    arc_rig,
    make_gaussians,
    object_points,
    synthetic_points,
)
from gsstream_lab.bench.state import mid_stream_state
from gsstream_lab.bench.timing import Progress, Timing, torch_threads
from gsstream_lab.jobs.machine import machine_facts

SCHEMA = "gsstream-bench-frame-1"
#: A tile has changed when a pixel of it did by more than this without noise, [0, 1] units.
CHANGED = 3 / 255
NOISE = 1.5 / 255
#: Threshold of change of the variant "active", sigmas of noise, where the recipe has none.
CHANGE_THRESHOLD = 4.0
#: Slots that decide what may change, as parts that let everything change.
DENSE = {"confidence": "uniform", "propagation": "group-max", "gate": "always-open", "regularizer": "none"}


@dataclass(frozen=True)
class FramePlan:
    """What is measured."""

    recipe: Recipe  # what :func:`variants` are made of
    shares: tuple[float, ...]  # of tiles that change, [0, 1], at ``static[0]`` Gaussians
    static: tuple[int, ...]  # Gaussians of the part that stands still; at every size the object alone moves in one case
    moving: int  # Gaussians of the object
    views: int
    width: int
    height: int
    repetitions: int
    warm_up: int
    shift: float = 1.0  # how far everything moving moves, in pixels
    seed: int = 0


@dataclass(frozen=True, slots=True)
class _Ball:
    """What moves: everything nearer to ``center`` than ``radius``."""

    center: tuple[float, float, float]
    radius: float

    def holds(self, scene: Gaussians[FloatArray]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return [N] bool: rows inside the ball."""
        distance = np.linalg.norm(scene.means - np.asarray(self.center, np.float32), axis=1)
        return np.asarray(distance < self.radius)


#: The object as a whole, and the point of it nearest to the cameras, around which the shares are measured.
_OBJECT = _Ball(OBJECT_CENTER, OBJECT_ROOM)
_FRONT = (OBJECT_CENTER[0], OBJECT_CENTER[1], OBJECT_CENTER[2] - OBJECT_RADIUS)


@dataclass(frozen=True)
class _Case:
    """A prepared frame: the state before it, the frame, its images without noise, and what describes it."""

    state: StreamState
    frame: Frame
    clean: FloatArray
    facts: Mapping[str, Any]


def bench_frame(plan: FramePlan, catalog: Catalog, progress: Progress) -> dict[str, Any]:
    """Measure everything in the plan; plain JSON values."""
    machine = machine_facts()
    parts = {name: assemble(recipe, catalog) for name, recipe in variants(plan.recipe).items()}
    results: list[dict[str, Any]] = []
    # One torch thread, as in a run: see engine.run.encoder.one_torch_thread.
    with torch_threads(1):
        for static in plan.static:
            for sweep, ball in _balls(plan, parts["active"], static, progress):
                progress(f"{static / 1000:g}k static Gaussians, {sweep}: frame")
                cases = {name: _case(plan, part, static, ball) for name, part in parts.items()}
                for name, step, timing in _timed(plan, parts, cases):
                    facts = {"sweep": sweep, "variant": name, "static": static, **cases[name].facts}
                    results.append({**facts, **_outcome(parts[name], cases[name], step), **timing})
    return {
        "schema": SCHEMA,
        "machine": machine,
        "settings": {
            "method": plan.recipe.method,
            "renderer": parts["active"].recipe.renderer.name,
            "change_threshold": parts["active"].recipe.stream.change_threshold,
            "epochs": plan.recipe.stream.epochs,
            "views": plan.views,
            "width": plan.width,
            "height": plan.height,
            "moving": plan.moving,
            "shift_pixels": plan.shift,
            "noise": NOISE,
            "seed": plan.seed,
            "repetitions": plan.repetitions,
            "warm_up": plan.warm_up,
            "torch_threads": 1,
        },
        "cases": results,
        "peak_memory_mb": peak_memory_mb(),
    }


def variants(recipe: Recipe) -> dict[str, Recipe]:
    """Return the variants dense (every gate open), gated (the recipe's gates) and active (and only what changed)."""
    threshold = recipe.stream.change_threshold or CHANGE_THRESHOLD
    active = recipe.model_copy(update={"stream": recipe.stream.model_copy(update={"change_threshold": threshold})})
    gated = recipe.model_copy(update={"stream": recipe.stream.model_copy(update={"change_threshold": 0.0})})
    dense = gated.model_copy(update={slot: ComponentRef(name=name) for slot, name in DENSE.items()})
    return {"dense": dense, "gated": gated, "active": active}


def _balls(plan: FramePlan, parts: Assembly, static: int, progress: Progress) -> list[tuple[str, _Ball]]:
    """(sweep, what moves) of every case of one size."""
    cases = [("object moves", _OBJECT)]
    if static != plan.static[0]:
        return cases
    scene, rig = _scene(plan, static), _rig(plan, parts)
    before = _draw(parts, scene, rig)
    for share in plan.shares:
        progress(f"{static / 1000:g}k static Gaussians: which ball changes {share:.0%} of the tiles")
        name = "everything moves" if share >= 1 else f"{share:.0%} of tiles"
        cases.append((name, _Ball(_FRONT, _radius_for(plan, parts, scene, rig=rig, before=before, share=share))))
    return cases


def _radius_for(
    plan: FramePlan, parts: Assembly, scene: Gaussians[FloatArray], rig: Cameras, before: FloatArray, share: float
) -> float:
    """Radius of the ball whose motion changes this share of tiles, by bisection; 0 and infinity at the ends."""
    if share <= 0:
        return 0.0
    if share >= 1:
        return np.inf
    low, high = 0.0, 16.0
    for _ in range(12):
        radius = (low + high) / 2 if high < 1 else np.sqrt(max(low, 0.01) * high)
        after = _draw(parts, _moved(plan, scene, rig, _Ball(_FRONT, radius)), rig)
        low, high = (radius, high) if _changed_share(before, after) < share else (low, radius)
    return float(high)


def _case(plan: FramePlan, parts: Assembly, static: int, ball: _Ball) -> _Case:
    rig = _rig(plan, parts)
    player = _first_player(parts, _scene(plan, static), rig)
    before = _draw(parts, player.gaussians, rig)
    noise = Rng(plan.seed).numpy("bench noise")
    state: StreamState = _encoder(parts, rig, player).encode(Frame(0, 0.0, before, rig)).state
    # The method stores rows in its own order, which rounds the scene anew. Images are rendered from that scene, so that
    # what stands still does not seem to change.
    before = _draw(parts, state.player.gaussians, rig)
    state = replace(state, previous=Frame(0, 0.0, _noisy(before, noise), rig))
    after = _draw(parts, _moved(plan, state.player.gaussians, rig, ball), rig)
    inside = ball.holds(state.player.gaussians)
    facts = {
        "gaussians": len(inside),
        "moving": int(inside.sum()),
        "changed_tiles": round(_changed_share(before, after), 5),
    }
    return _Case(state, Frame(1, 1 / 30, _noisy(after, noise), rig), after, facts)


def _encoder(parts: Assembly, rig: Cameras, first: PlayerState | None = None) -> Encoder:
    info = SourceInfo(name="synthetic", uri="bench", num_frames=None, fps=30.0, train=rig, test=rig.select([]))
    return Encoder(parts, info, first_frame=first)


def _scene(plan: FramePlan, static: int) -> Gaussians[FloatArray]:
    degree = plan.recipe.first_frame.sh_degree
    still = make_gaussians(synthetic_points(static, plan.seed), plan.seed, degree=degree)
    moving = make_gaussians(object_points(plan.moving, plan.seed), plan.seed + 1, degree=degree)
    parts = dict(still.items())
    return Gaussians(**{name: np.concatenate([parts[name], value]) for name, value in moving.items()})


def _rig(plan: FramePlan, parts: Assembly) -> Cameras:
    rig = arc_rig(plan.views, plan.width, plan.height)
    return replace(rig, near_plane=parts.recipe.near * rig.extent)


def _first_player(parts: Assembly, scene: Gaussians[FloatArray], rig: Cameras) -> PlayerState:
    """The scene as a decoded key packet, every Gaussian a node of its own; the method lays its own groups over it."""
    count = len(scene)
    cell = np.float32(np.exp(np.median(scene.scales)))
    layout = Layout(np.ones(count, np.int32), np.zeros(count, np.uint8), np.array([cell], np.float32))
    extra = {"origin": scene.means.min(0).tolist()}
    meta = StreamMeta(
        method="bench",
        source="synthetic",
        recipe={},
        train=rig,
        test=rig.select([]),
        fps=30.0,
        background=parts.background,
        extra=extra,
    )
    return decode_packet(None, encode_key(KeyState(scene, layout, meta), frame=0).data)


def _moved(plan: FramePlan, scene: Gaussians[FloatArray], rig: Cameras, ball: _Ball) -> Gaussians[FloatArray]:
    """Everything within the ball, moved along x and y by as much as ``shift`` pixels are at its distance."""
    distance = np.linalg.norm(scene.means - rig.centers.mean(0), axis=1)
    step = (plan.shift / float(rig.Ks[0, 0, 0]) * distance * ball.holds(scene)).astype(np.float32)
    return replace(scene, means=scene.means + step[:, None] * np.array([0.8, 0.6, 0], np.float32))


def _draw(parts: Assembly, scene: Gaussians[FloatArray], rig: Cameras) -> FloatArray:
    """[C, H, W, 3] all views of a scene, cut at 1 as a camera would."""
    tensors = scene.map(torch.from_numpy)
    with torch.no_grad():
        views = [parts.renderer.render(tensors, rig, i, parts.background).image for i in range(len(rig))]
    return np.stack([view.numpy() for view in views]).clip(0, 1)


def _noisy(images: FloatArray, noise: np.random.Generator) -> FloatArray:
    return (images + noise.normal(0, NOISE, images.shape)).clip(0, 1).astype(np.float32)


def _changed_share(before: FloatArray, after: FloatArray) -> float:
    """Mean over views of the share of tiles in which a pixel changed by more than CHANGED."""
    changed = np.abs(after - before).max(3) > CHANGED
    views, height, width = changed.shape
    padded = np.zeros((views, -(-height // TILE) * TILE, -(-width // TILE) * TILE), bool)
    padded[:, :height, :width] = changed
    tiles = padded.reshape(views, padded.shape[1] // TILE, TILE, padded.shape[2] // TILE, TILE).any((2, 4))
    return float(tiles.mean())


def _timed(
    plan: FramePlan, assemblies: Mapping[str, Assembly], cases: Mapping[str, _Case]
) -> Sequence[tuple[str, EncodedFrame, dict[str, Any]]]:
    """Every variant's step in turn, several times over: (variant, last step, ms of the whole and by phase)."""
    total: dict[str, list[float]] = {name: [] for name in assemblies}
    work: dict[str, list[float]] = {name: [] for name in assemblies}
    phases: dict[str, dict[str, list[float]]] = {name: {} for name in assemblies}
    last: dict[str, EncodedFrame] = {}
    for round_ in range(plan.warm_up + plan.repetitions):
        for name, parts in assemblies.items():
            state = mid_stream_state(parts, cases[name].state, last.get(name))
            encoder = _encoder(parts, cases[name].frame.cameras)
            encoder.state = state
            started, worked = time.perf_counter(), time.process_time()
            last[name] = encoder.encode(cases[name].frame)
            elapsed, spent = time.perf_counter() - started, time.process_time() - worked
            if round_ < plan.warm_up:
                continue
            total[name].append(1000 * elapsed)
            work[name].append(1000 * spent)
            for phase, seconds in last[name].metrics["seconds"].items():
                phases[name].setdefault(phase, []).append(1000 * seconds)
    out = []
    for name, step in last.items():
        by_phase = {phase: {"min": min(v), "median": median(v)} for phase, v in phases[name].items()}
        timing = Timing(tuple(total[name]), tuple(work[name])).to_json()
        out.append((name, step, {"total_ms": timing, "phases_ms": by_phase}))
    return out


def _outcome(parts: Assembly, case: _Case, step: EncodedFrame) -> dict[str, Any]:
    """What the frame became: how much took part, what it weighs, how close it comes to the frame without noise."""
    shown = _draw(parts, step.state.player.gaussians, case.frame.cameras)
    stood = _draw(parts, case.state.player.gaussians, case.frame.cameras)
    quality = {"psnr": shown, "psnr_if_held": stood}
    keys = ("candidate_gaussians", "sent_gaussians", "iterations")
    return {
        "status": step.status,
        "bytes": len(step.packet.data),
        **{key: step.metrics[key] for key in keys if key in step.metrics},
        **{name: _mean_psnr(images, case.clean) for name, images in quality.items()},
    }


def _mean_psnr(images: FloatArray, clean: FloatArray) -> float | None:
    """Mean over views, dB; None where an image is met exactly."""
    value = float(np.mean([psnr(image, truth) for image, truth in zip(images, clean, strict=True)]))
    return round(value, 3) if np.isfinite(value) else None
