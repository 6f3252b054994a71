"""The renderers at the extremes: every one of them against the reference in float64, or refused in the same words.

The image and gradients of ordinary scenes, every instruction set and the incremental mode are held to float64 by
plugins/cpu_render/tests; here are the corners of the domain.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from numeric_scenes import Scene, blobs, camera, random_scene, rendered, upstream, worst

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.player.software import render_numpy

BACK = (0.2, 0.5, 0.9)


def renderers() -> dict[str, Renderer]:
    try:
        from gsstream_cpu_render.renderer import CpuRenderer
    except ImportError:
        return {"reference": ReferenceRenderer()}
    return {"reference": ReferenceRenderer(), "cpu": CpuRenderer()}


RENDERERS = renderers()
needs_native = pytest.mark.skipif("cpu" not in RENDERERS, reason="gsstream-cpu-render is not installed")
HERE = [[0.1, 0.1, 0.0]]
PILE = [[0.01, 0.01, 0]] * 2000
STACK = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
#: Scene and camera, and how far gradients may be from float64 by the largest of all attributes.
CASES: dict[str, tuple[Scene, Cameras, float]] = {
    "just beyond the near plane": (blobs([[1e-4, 1e-4, -2.98999]], -9.0), camera(), 1e-4),
    "covers the whole screen": (blobs(HERE, 5.0), camera(), 1e-4),
    "a million times the screen": (blobs(HERE, 18.0), camera(), 1e-4),
    "far smaller than a pixel": (blobs(HERE, -15.0), camera(), 1e-4),
    "opaque: logit 20": (blobs(HERE, opacities=20.0), camera(), 1e-4),
    "opaque: logit 40": (blobs(HERE, opacities=40.0), camera(), 1e-4),
    "transparent: logit -40": (blobs(HERE, opacities=-40.0), camera(), 1e-4),
    "thousands on one pixel": (blobs(PILE, -4.0, opacities=-5.0, sh0=STACK), camera(width=8, height=8), 1e-3),
    "thousands, opaque": (blobs(PILE, -4.0, opacities=8.0, sh0=STACK), camera(width=8, height=8), 1e-4),
    "quaternion of norm 1e-9": (blobs(HERE, [-1, -2, -1.5], [1e-9, 3e-10, 0, 2e-10]), camera(), 1e-4),
    "quaternion of norm 1e9": (blobs(HERE, [-1, -2, -1.5], [1e9, 3e8, 0, 2e8]), camera(), 1e-4),
    "one pixel": (blobs(HERE), camera(width=1, height=1), 1e-4),
    "one row": (blobs(HERE), camera(width=97, height=1), 1e-4),
    "one column": (blobs(HERE), camera(width=1, height=97), 1e-4),
    "focal length of 1 pixel": (blobs(HERE), camera(focal=1.0), 1e-4),
    "focal length of a million pixels": (blobs([[1e-6, 1e-6, 0]], [-11, -12, -12]), camera(focal=1e6), 1e-4),
    "principal point far outside": (blobs([[30.5, -52, 0]], [2, 1, 1]), camera(center=(-500, 900)), 1e-4),
    "harmonics below zero": (blobs(HERE, sh0=(-1e4, 3.0, -1.0)), camera(), 1e-4),
    "harmonics of ten thousand": (blobs(HERE, sh0=(1e4, 3.0, -1.0)), camera(), 1e-4),
    "ten million units away": (blobs([[0.1, 0.1, 1e7]], 14.0), camera(), 1e-4),
    "needle of condition 1e2": (blobs(HERE, [0.0, math.log(0.01), math.log(0.01)]), camera(), 1e-3),
    "behind the near plane": (blobs([[0, 0, -2.99], [0, 0, -3.0], [0, 0, -9.0]]), camera(), 1e-4),
}


@pytest.mark.parametrize("name", RENDERERS)
@pytest.mark.parametrize("case", CASES)
def test_image_and_gradients_against_float64(case: str, name: str) -> None:
    scene, cameras, tolerance = CASES[case]
    grad = upstream(cameras)
    got, gradients = rendered(RENDERERS[name], scene, cameras, grad)
    want, exact = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)
    assert worst(got, want) < 2e-5
    # By the largest of the scene: the true gradient of a sphere's rotation is 0.
    scale = max(float(value.abs().max()) for _, value in exact.items() if value.numel())
    for key, value in gradients.items():
        # Gradients of raw quaternions grow as their norm falls.
        unit = float(scene.quats.norm(dim=1).max()) if key == "quats" else 1.0
        assert worst(value * unit, getattr(exact, key) * unit, scale) <= tolerance, key


@pytest.mark.parametrize("case", CASES)
def test_the_players_renderer_agrees(case: str) -> None:
    scene, cameras, _ = CASES[case]
    arrays = [value.numpy() for _, value in scene.items()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        got = render_numpy(arrays, cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, BACK)
    want, _ = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, upstream(cameras))
    assert worst(torch.from_numpy(got), want) < 1e-6


@pytest.mark.parametrize("focal", [50.0, 600.0])
@needs_native
def test_needles_of_condition_1e8_give_a_right_image_and_finite_gradients(focal: float) -> None:
    """Gradients along such a needle cancel to nothing; what float32 leaves of them is noise, and only its being finite
    is promised (docs/reference/numerics.md, compositing)."""
    scene = blobs(HERE, [math.log(10), math.log(1e-7), math.log(1e-7)])
    cameras = camera(focal=focal, width=160, height=90)
    grad = upstream(cameras)
    got, gradients = rendered(RENDERERS["cpu"], scene, cameras, grad)
    want, _ = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)
    assert worst(got, want) < 5e-3
    assert all(bool(torch.isfinite(value).all()) for _, value in gradients.items())


def test_an_opaque_gaussian_can_become_transparent_again() -> None:
    """1 - sigmoid(x) is exactly 0 in float32 from x = 17 on; its gradient then was, too, and nothing could undo it."""
    scene, cameras = CASES["opaque: logit 20"][:2]
    if "cpu" not in RENDERERS:
        pytest.skip("gsstream-cpu-render is not installed")
    grad = upstream(cameras)
    got = rendered(RENDERERS["cpu"], scene, cameras, grad)[1].opacities
    want = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)[1].opacities
    assert float(want) != 0
    assert float(got) == pytest.approx(float(want), rel=1e-4)


@pytest.mark.parametrize("name", RENDERERS)
@pytest.mark.parametrize("norm", [0.0, 1e-12, 1e12])
def test_a_quaternion_without_direction_is_refused_by_every_renderer(name: str, norm: float) -> None:
    scene = blobs([[0, 0, 0], [0.1, 0, 0]], quats=[[1, 0, 0, 0], [norm, 0, 0, 0]])
    with pytest.raises(ValueError, match=r"quats: expected norms between 1e-10 and 1e.?10, got .* at row 1"):
        RENDERERS[name].render(scene, camera(), 0, BACK)


@pytest.mark.parametrize("name", RENDERERS)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("attribute", ["means", "quats", "scales", "opacities", "sh0"])
def test_a_value_that_is_not_finite_never_reaches_the_image(name: str, attribute: str, bad: float) -> None:
    scene = blobs([[0, 0, 0], [0.1, 0, 0]])
    getattr(scene, attribute).reshape(2, -1)[1, 0] = bad
    with pytest.raises(ValueError, match=r"expected (finite|norms)"):
        RENDERERS[name].render(scene, camera(), 0, BACK)


def test_a_size_that_overflows_is_refused_by_the_reference() -> None:
    """exp(100) squared leaves float32: the image was wrong by 0.4 and the gradients were NaN."""
    with pytest.raises(ShapeError, match=r"covariances on the screen .*: expected finite values"):
        ReferenceRenderer().render(blobs(HERE, 100.0), camera(), 0, BACK)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
@needs_native
def test_the_native_renderer_takes_float32_alone_and_says_so(kind: torch.dtype) -> None:
    scene = blobs(HERE).map(lambda value: value.to(kind))
    words = rf"means: expected (dtype )?float32, got .*{str(kind).removeprefix('torch.')}"
    with pytest.raises(ShapeError, match=words):
        RENDERERS["cpu"].render(scene, camera(), 0, BACK)


def test_cameras_whose_matrices_no_renderer_reads_whole_are_refused() -> None:
    rig = camera()
    rig.validate()
    for field, place, value, words in (
        ("Ks", (0, 0, 1), 0.5, "no skew"),
        ("Ks", (0, 2, 2), 2.0, "last row 0 0 1"),
        ("viewmats", (0, 3, 0), 0.1, "last row 0 0 0 1"),
        ("Ks", (0, 0, 2), np.nan, "expected finite"),
    ):
        spoilt = Cameras(rig.ids, rig.viewmats.copy(), rig.Ks.copy(), rig.width, rig.height)
        getattr(spoilt, field)[place] = value
        with pytest.raises(ShapeError, match=words):
            spoilt.validate()
    for near in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ShapeError, match="near plane"):
            camera(near=near).validate()


@needs_native
def test_instruction_sets_agree_among_themselves() -> None:
    """Up to rounding: another set sums in another order. Also: an idle rasteriser made for one set is not used for
    another (it was, and every comparison of sets through the renderer compared a set with itself)."""
    native = pytest.importorskip("gsstream_cpu_render._native")
    cameras, grad = camera(), upstream(camera())
    before = native.active_isa()
    found = {}
    for name in native.supported_isas():
        native.select_isa(name)
        found[name] = rendered(RENDERERS["cpu"], random_scene(5), cameras, grad)
        again, _ = rendered(RENDERERS["cpu"], random_scene(5), cameras, grad)
        assert torch.equal(again, found[name][0]), "an idle object of another set was used"
    native.select_isa(before)
    first_image, first_gradients = next(iter(found.values()))
    for image, gradients in found.values():
        assert worst(image, first_image) < 2e-6
        for (_, a), (_, b) in zip(gradients.items(), first_gradients.items(), strict=True):
            assert worst(a, b) < 2e-5
