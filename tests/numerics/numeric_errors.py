"""Worst relative errors of the stages that render and compare, against the same formulas in float64. One seed each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numeric_scenes import camera, random_scene, rendered, upstream, worst

from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.reference import ReferenceRenderer, composite, evaluate_sh, project
from gsstream.parts.render.loss import Loss, ReferenceLoss
from gsstream.player.software import render_numpy
from gsstream.testing.cases import rig

Measure = Callable[[int], float]


def cameras_error(seed: int) -> float:
    """Centres of a rig, by solving instead of transposing."""
    cameras = rig(5)
    solved = [np.linalg.solve(v[:3, :3].astype(np.longdouble).astype(float), -v[:3, 3]) for v in cameras.viewmats]
    return worst(torch.from_numpy(cameras.centers), torch.from_numpy(np.array(solved)))


def projection(seed: int) -> float:
    scene, cameras = random_scene(seed), camera()
    got, want = project(scene, cameras, 0), project(scene.map(torch.Tensor.double), cameras, 0)
    return max(worst(got[0], want[0]), worst(got[1], want[1]), worst(got[3], want[3]))


def harmonics(seed: int) -> float:
    scene = random_scene(seed, n=200, bases=16)
    directions = torch.randn(200, 3, generator=torch.Generator().manual_seed(seed)) * 10.0 ** (seed % 7 - 3)
    parts = (scene.sh0, scene.shN, directions)
    return worst(evaluate_sh(*parts), evaluate_sh(*(part.double() for part in parts)))


def compositing(seed: int) -> float:
    scene, cameras = random_scene(seed, n=60), camera()
    means2d, conics, colors, depths, opacities = project(scene.map(torch.Tensor.double), cameras, 0)
    order = torch.argsort(depths)
    parts = [part[order].float() for part in (means2d, conics, colors, opacities)]
    background = torch.tensor([0.2, 0.5, 0.9])
    got = composite(*parts, 0, cameras.height, cameras.width, background)[0]
    exact = composite(*(p.double() for p in parts), 0, cameras.height, cameras.width, background.double())[0]
    # A pixel where alpha crosses 1/255 between the two precisions differs by that step; there is none in these scenes.
    return worst(got, exact)


def image(renderer: Renderer, seed: int) -> float:
    scene, cameras = random_scene(seed, bases=(1, 4, 9, 16)[seed % 4]), camera()
    grad = upstream(cameras, seed)
    got = rendered(renderer, scene, cameras, grad)[0]
    return worst(got, rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)[0])


def image_numpy(seed: int) -> float:
    scene, cameras = random_scene(seed, bases=(1, 4, 9, 16)[seed % 4]), camera()
    arrays = [value.numpy() for _, value in scene.items()]
    got = render_numpy(arrays, cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, (0.2, 0.5, 0.9))
    grad = upstream(cameras, seed)
    want = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)[0]
    return worst(torch.from_numpy(got), want)


def gradients(renderer: Renderer, seed: int) -> float:
    scene, cameras = random_scene(seed, bases=(1, 4, 9, 16)[seed % 4]), camera()
    grad = upstream(cameras, seed)
    got = rendered(renderer, scene, cameras, grad)[1]
    want = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)[1]
    return max(worst(a, b) for (_, a), (_, b) in zip(got.items(), want.items(), strict=True))


def screen(renderer: Renderer, seed: int) -> float:
    scene, cameras = random_scene(seed), camera()
    grad = upstream(cameras, seed)
    got = renderer.screen_gradient(scene, cameras, 0, grad)
    want = ReferenceRenderer().screen_gradient(scene.map(torch.Tensor.double), cameras, 0, grad.double())
    return worst(got.gradient, want.gradient)


def loss(part: Loss, which: int, seed: int) -> float:
    """``which``: 0 the value, 1 the gradient. Pictures that differ, hardly differ, and are flat."""
    g = torch.Generator().manual_seed(seed)
    target = torch.rand(23, 37, 3, generator=g)
    shown = (torch.rand(23, 37, 3, generator=g), target + 0.01 * torch.randn(23, 37, 3, generator=g), target * 0 + 1)[
        seed % 3
    ]
    target = target * 0 + 0.5 if seed % 3 == 2 else target
    got = part.evaluate(shown, part.prepare(target), 0.2)
    exact = ReferenceLoss().evaluate(shown.double(), ReferenceLoss().prepare(target.double()), 0.2)
    return worst(torch.as_tensor(got[which]), torch.as_tensor(exact[which], dtype=torch.float64))


def render_measures() -> dict[str, Measure]:
    """Stage -> measurement; those of the native kernels only where they are installed."""
    reference = ReferenceRenderer()
    measures: dict[str, Measure] = {
        "cameras": cameras_error,
        "projection": projection,
        "spherical harmonics": harmonics,
        "compositing": compositing,
        "image (reference)": lambda seed: image(reference, seed),
        "image (numpy player)": image_numpy,
        "gradients (reference)": lambda seed: gradients(reference, seed),
        "loss value (reference)": lambda seed: loss(ReferenceLoss(), 0, seed),
        "loss gradient (reference)": lambda seed: loss(ReferenceLoss(), 1, seed),
    }
    try:
        from gsstream_cpu_render.renderer import CpuLoss, CpuRenderer
    except ImportError:
        return measures
    native, native_loss = CpuRenderer(), CpuLoss()
    return measures | {
        "image (cpu)": lambda seed: image(native, seed),
        "gradients (cpu)": lambda seed: gradients(native, seed),
        "screen gradient (cpu)": lambda seed: screen(native, seed),
        "loss value (cpu)": lambda seed: loss(native_loss, 0, seed),
        "loss gradient (cpu)": lambda seed: loss(native_loss, 1, seed),
    }
