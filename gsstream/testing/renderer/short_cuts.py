"""What a session promises of its short cuts: the numbers of the calls that they stand for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from gsstream.core.changes.motion import Moves, transformed
from gsstream.engine.fit.backward import gradient_of
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.fit.judge import Judge
from gsstream.loss.base import Loss
from gsstream.motion.curvature import curvature_of
from gsstream.motion.pull_back import pulled_back
from gsstream.plugins.catalog import load_catalog
from gsstream.render.base import Comparison, Renderer, RenderSession
from gsstream.testing.cases import SIZE, Scene, world
from gsstream.testing.compare import equal, gradients_equal, relative
from gsstream.testing.registry import check

#: Of the largest value of a gradient. A renderer may blend what stands still once for all passes of a frame, and then
#: a pixel whose light is nearly used up may end a Gaussian later (docs/results/cost.md).
NEAR = 5e-3
WHY = "the same calls, up to rounding and the end of a pixel's light"
#: The least that slopes and curvatures of motions are measured by: a thousandth of what they are here.
SLOPE = 1e-5
#: What renders are compared with.
IMAGE = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(4))


def _losses() -> Iterator[tuple[str, Loss]]:
    catalog = load_catalog()
    for name in catalog.names("loss"):
        yield name, catalog.resolve("loss", name)()


def _opened(part: Renderer) -> tuple[RenderSession, Scene]:
    """A narrowed session, and other values of its rows."""
    case = world("cloud")
    active = torch.arange(0, len(case.gaussians), 9)
    session = part.open(case.gaussians, None, case.cameras, (0.2, 0.5, 0.9))
    session.narrow(active)
    g = torch.Generator().manual_seed(3)
    return session, case.gaussians.rows(active).map(lambda v: v + 0.02 * torch.randn(v.shape, generator=g))


def _comparison(loss: Loss) -> Comparison:
    """SSIM alone, because a pixel that L1 sees from its other side has a gradient of the other sign."""
    return Comparison(loss, loss.prepare(IMAGE), 1.0)


def _step_by_step(session: RenderSession, view: int, rows: Scene, wanted: Comparison) -> tuple[float, Scene]:
    leaves = rows.map(lambda value: value.clone().requires_grad_())
    output = session.render(view, leaves)
    assert isinstance(wanted.loss, Loss)
    value, gradient = wanted.loss.evaluate(output.image.detach(), wanted.target, wanted.dssim, output.tiles)
    output.image.backward(gradient)  # type: ignore[no-untyped-call]
    return value, leaves


def _moves(count: int) -> Moves:
    rng = np.random.default_rng(5)
    transforms = (0.02 * rng.standard_normal((3, 3)) for _ in range(3))
    return Moves(np.arange(count), np.arange(count) % 3, *transforms)


@check("renderer")
def check_renderer_short_cuts(part: Renderer) -> None:
    """Where sessions have ``pull`` and ``pull_moved``, they give what render, loss and backward pass give."""
    for name, loss in _losses():
        for view in (0, 1):
            session, rows = _opened(part)
            pulled = session.pull(view, rows, _comparison(loss))
            if pulled is None:
                continue
            value, leaves = _step_by_step(_opened(part)[0], view, rows, _comparison(loss))
            equal(f"loss {name!r}, camera {view}: loss", torch.tensor(pulled.loss), torch.tensor(value), 1e-4, WHY)
            got, expected = dict(pulled.gradients.items()), dict(leaves.map(gradient_of).items())
            gradients_equal(f"loss {name!r}, camera {view}", got, expected, NEAR, WHY)
            _check_moved(part, view, loss, name)


def _check_moved(part: Renderer, view: int, loss: Loss, name: str) -> None:
    session, rows = _opened(part)
    before = rows.map(torch.Tensor.numpy)
    moves = _moves(len(rows))
    found = session.pull_moved(view, before, moves, _comparison(loss), curved=True)
    if found is None:
        return
    there = transformed(before, moves).map(torch.from_numpy)
    value, leaves = _step_by_step(_opened(part)[0], view, there, _comparison(loss))
    slope = torch.from_numpy(pulled_back(leaves, moves))
    equal(f"loss {name!r}, camera {view}: loss after motions", torch.tensor(found.loss), torch.tensor(value), 1e-4, WHY)
    got = torch.from_numpy(found.slope)
    relative(f"loss {name!r}, camera {view}: slope of motions", got, slope, NEAR, WHY, floor=SLOPE)
    assert found.curvature is not None, f"loss {name!r}, camera {view}: pull_moved was asked for curvature, got none"
    judge = Judge(loss, 1.0, IMAGE[None].expand(view + 1, -1, -1, -1).numpy(), None)
    structure = judge.structure(_opened(part)[0], view, there)
    curvature = torch.from_numpy(curvature_of(there.means.numpy(), moves, world("cloud").cameras, view, structure))
    got = torch.from_numpy(found.curvature)
    relative(f"loss {name!r}, camera {view}: curvature of motions", got, curvature, NEAR, WHY, floor=SLOPE)


@check("renderer")
def check_renderer_whole(part: Renderer) -> None:
    """Where sessions have ``pull_whole``, it gives what render, loss and backward pass give of a whole scene."""
    for name, loss in _losses():
        _check_whole(part, loss, name)


def _check_whole(part: Renderer, loss: Loss, name: str) -> None:
    case = world("cloud")
    rows, view = case.gaussians, 1
    g = torch.Generator().manual_seed(6)
    exposure = Exposure(torch.eye(3) + 0.1 * torch.randn(2, 3, 3, generator=g), 0.1 * torch.randn(2, 3, generator=g))
    images = IMAGE[None].expand(view + 1, -1, -1, -1).numpy()
    judge = Judge(loss, 1.0, images, exposure)
    session = part.open(rows, None, case.cameras, (0.2, 0.5, 0.9))
    found = session.pull_whole(view, rows, judge.comparison(view))
    if found is None:
        return
    expected = judge.pull_whole(session, view, rows)
    equal(f"loss {name!r}, whole scene: loss", torch.tensor(found.loss), torch.tensor(expected.loss), 1e-4, WHY)
    got, want = ({**dict(pull.gradients.items()), "2-D means": pull.means2d} for pull in (found, expected))
    gradients_equal(f"loss {name!r}, whole scene", _given(got), _given(want), 1e-5, WHY)
    maps = _given({"colour map": found.colours}), _given({"colour map": expected.colours})
    gradients_equal(f"loss {name!r}, whole scene", *maps, 1e-5, WHY)


def _given(gradients: Mapping[str, torch.Tensor | None]) -> dict[str, torch.Tensor]:
    """Return the gradients; raise AssertionError where one that was asked for is None."""
    missing = [name for name, value in gradients.items() if value is None]
    assert not missing, f"expected a gradient of each of {sorted(gradients)}, got None for {missing}"
    return {name: value for name, value in gradients.items() if value is not None}
