"""What a renderer promises: pictures that agree with the reference, and sessions that agree with fresh renders."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.core.cameras import Cameras
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.reference import ALPHA_CUT, project
from gsstream.parts.render.backward import gradient_of
from gsstream.parts.render.images import TILE
from gsstream.parts.render.session import RenderOutput
from gsstream.testing import loss_and_change as loss_and_change  # the checks of these three register themselves
from gsstream.testing import loss_and_grad as loss_and_grad
from gsstream.testing import optimiser as optimiser
from gsstream.testing.cases import BLACK, RENDERER, SIZE, Scene, fingerprint, get_case
from gsstream.testing.compare import EXACT, at_most, equal, finite, gradients_equal, relative
from gsstream.testing.registry import check

WORLDS = ("empty", "one", "two identical", "line", "cloud", "far", "tiny", "vast", "thin", "unseen")
GREY = (0.2, 0.5, 0.9)
#: One alpha at the cut of 1/255 may fall on either side in another arithmetic; so may the last Gaussian of a pixel.
CUT = 1e-2
SUMS = "sums of float32 in another order"


Color = tuple[float, float, float]


def _draw(part: Renderer, scene: Scene, cameras: Cameras, view: int = 0, behind: Color = GREY) -> RenderOutput:
    with torch.no_grad():
        return part.render(scene, cameras, view, behind)


def _next(scene: Scene, rows: torch.Tensor) -> Scene:
    """The scene with every attribute of some rows changed, as the next frame may have it."""
    shift = {"means": 0.07, "quats": 0.1, "scales": 0.3, "opacities": -0.8, "sh0": 0.4, "shN": 0.2}
    add = torch.zeros(len(scene)).index_fill(0, rows, 1.0)
    return type(scene)(**{n: v + shift[n] * add.reshape(-1, *[1] * (v.dim() - 1)) for n, v in scene.items()})


@check("renderer")
def check_renderer_range(part: Renderer) -> None:
    """[H, W, 3] and [H, W], finite; a pixel lies between 0 and the brightest colour; nothing drawn is background."""
    for name in WORLDS:
        case = get_case(name)
        got = _draw(part, case.gaussians, case.cameras)
        shapes = (tuple(got.image.shape), tuple(got.alpha.shape))
        assert shapes == ((SIZE, SIZE, 3), (SIZE, SIZE)), f"world {name!r}: expected [{SIZE}, {SIZE}, 3], got {shapes}"
        finite(f"world {name!r}: image", got.image)
        finite(f"world {name!r}: alpha", got.alpha)
        # Degree 0: the colour of a Gaussian is 0.5 + 0.28... sh0 from everywhere.
        colours = 0.5 + 0.28209479177387814 * case.gaussians.sh0.reshape(-1)
        brightest = max(float(torch.cat([colours, torch.zeros(1)]).max()), max(GREY))
        why = "a weighted mean of colours, each at least 0"
        at_most(f"world {name!r}: image", got.image, brightest, tolerance=1e-5, why=why)
        dark = _draw(part, case.gaussians, case.cameras, view=0, behind=BLACK).image
        at_most(f"world {name!r}: image below 0", -dark, 0.0, tolerance=1e-5, why=why)
        at_most(f"world {name!r}: alpha", got.alpha, 1.0, tolerance=1e-5, why="1 - transmittance")
        at_most(f"world {name!r}: alpha below 0", -got.alpha, 0.0, tolerance=1e-5, why="1 - transmittance")
    nothing = _draw(part, get_case("empty").gaussians, get_case("empty").cameras).image
    equal("no Gaussians", nothing, torch.tensor(GREY).expand(SIZE, SIZE, 3), tolerance=1e-6, why="the background alone")


@check("renderer")
def check_renderer_reference(part: Renderer) -> None:
    """Image and alpha are those of the reference renderer, from every camera."""
    for name in ("line", "cloud", "thin", "unseen"):
        case = get_case(name)
        for view in range(len(case.cameras)):
            got, want = (_draw(each, case.gaussians, case.cameras, view) for each in (part, RENDERER))
            for what, a, b in (("image", got.image, want.image), ("alpha", got.alpha, want.alpha)):
                equal(
                    f"world {name!r}, camera {view}: {what}",
                    a,
                    b,
                    tolerance=CUT,
                    why="an alpha at the cut of 1/255 may go over",
                )
                mean = (a - b).abs().mean()
                at_most(f"world {name!r}, camera {view}: mean error of {what}", mean, 0.0, tolerance=1e-4, why=SUMS)


@check("renderer")
def check_renderer_gradient(part: Renderer) -> None:
    """The gradient of every attribute is that of the reference renderer, from every camera."""
    case = get_case("cloud")
    weights = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(8))
    for view in range(len(case.cameras)):
        got, want = (case.gaussians.map(lambda v: v.clone().requires_grad_()) for _ in range(2))
        for each, leaves in ((part, got), (RENDERER, want)):
            drawn = each.render(leaves, case.cameras, view, GREY)
            (drawn.image * weights).sum().backward()  # type: ignore[no-untyped-call]
        a, b = (dict(leaves.map(gradient_of).items()) for leaves in (got, want))
        gradients_equal(f"camera {view}", a, b, tolerance=CUT, why="an alpha at the cut of 1/255 may go over")


@check("renderer")
def check_renderer_repeatable(part: Renderer) -> None:
    """The same scene gives the same image, bit for bit; scene and cameras come out as they went in."""
    case = get_case("cloud")
    scene = replace(case.gaussians, opacities=case.gaussians.opacities.clone())
    scene.opacities[::3] = 9.0  # nearly opaque
    before = fingerprint((scene, case.cameras))
    first = _draw(part, scene, case.cameras).image.clone()
    part.screen_gradient(scene, case.cameras, 0, torch.ones(SIZE, SIZE, 3))
    assert fingerprint((scene, case.cameras)) == before, "the scene or the cameras were changed in place"
    equal("second render of the same scene", _draw(part, scene, case.cameras).image, first)


@check("renderer")
def check_renderer_screen_gradient(part: Renderer) -> None:
    """Agrees with finite differences of the reference, in pixels; who is not in view has none and is not visible."""
    case = get_case("line")
    weights = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(6))
    got = part.screen_gradient(case.gaussians, case.cameras, 1, weights)
    picked = torch.arange(0, len(case.gaussians), 3)
    want, eps = torch.zeros(len(picked), 2, dtype=torch.float64), 1e-5
    double = case.gaussians.map(torch.Tensor.double)
    for place, row in enumerate(picked):
        for axis in range(2):
            ends = []
            for sign in (1, -1):
                nudge = torch.zeros(len(double), 2, dtype=torch.float64)
                nudge[row, axis] = sign * eps
                ends.append((RENDERER.nudged(double, case.cameras, 1, nudge).image * weights).sum())
            want[place, axis] = (ends[0] - ends[1]) / (2 * eps)
    relative("gradient of the 2-D means", got.gradient[picked], want.float(), tolerance=5e-3, why=SUMS, floor=0.1)

    case = get_case("unseen")
    got = part.screen_gradient(case.gaussians, case.cameras, 0, weights)
    hidden = case.gaussians.means[:, 1] > 10
    assert not bool(got.visible[hidden].any()), "Gaussians far outside the image are called visible"
    at_most("gradient of what is not in view", got.gradient[hidden].abs(), 0.0, tolerance=0.0, why=EXACT)
    moved = (got.gradient != 0).any(1)
    assert not bool((moved & ~got.visible).any()), "a Gaussian has a gradient and is not called visible"
    session = part.open(case.gaussians, None, case.cameras, GREY)
    few, whole = session.screen_gradient_rows(0, weights), session.screen_gradient(0, weights).gradient
    assert bool((few.rows[1:] > few.rows[:-1]).all()), "screen_gradient_rows: rows that are not in ascending order"
    spread = torch.zeros_like(whole).index_copy(0, few.rows, few.gradient)
    equal(
        "screen_gradient_rows, against screen_gradient",
        spread,
        whole,
        tolerance=1e-5,
        why="sums that a GPU makes in no fixed order",
    )


@check("renderer")
def check_renderer_contributing(part: Renderer) -> None:
    """Who has a gradient in marked tiles is visible in them, and the footprint of who is visible meets one of them."""
    weights = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(7))
    count = -(-SIZE // TILE)
    first, last = (torch.arange(count * count).reshape(count, count) == place for place in (0, count * count - 1))
    masks = (first, last, first | True)
    for name in ("empty", "line", "cloud", "unseen"):
        case = get_case(name)
        session = part.open(case.gaussians, None, case.cameras, GREY)
        for view in range(len(case.cameras)):
            for mask in masks:
                what = f"world {name!r}, camera {view}, tiles {mask.int().tolist()}"
                seen = session.visible(view, mask)
                shape = (tuple(seen.shape), seen.dtype)
                assert shape == ((len(case.gaussians),), torch.bool), f"{what}: expected [N] bool, got {shape}"
                inside = mask.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:SIZE, :SIZE, None]
                moved = (session.screen_gradient(view, weights * inside).gradient != 0).any(1)
                left_out = (moved & ~seen).nonzero()[:, 0].tolist()
                assert not left_out, f"{what}: rows {left_out} have a gradient and are not visible"
                reached = _reached(case.gaussians, case.cameras, view, mask)
                too_many = (seen & ~reached).nonzero()[:, 0].tolist()
                assert not too_many, f"{what}: rows {too_many} are visible and reach no marked tile"
        session.narrow(torch.arange(0, len(case.gaussians), 9))
        fresh = part.open(case.gaussians, None, case.cameras, GREY)
        got, want = (each.visible(0, masks[-1]) for each in (session, fresh))
        equal(f"world {name!r}: visible in the narrowed session", got, want)
        for tiles in ([last] * len(case.cameras), [last, first], [last & False] * len(case.cameras)):
            asked = torch.stack([*tiles, *[first & False] * (len(case.cameras) - len(tiles))])[: len(case.cameras)]
            elementwise = torch.stack([fresh.visible(view, asked[view]) for view in range(len(asked))]).any(0)
            equal(f"world {name!r}: visible anywhere", session.visible_anywhere(asked), elementwise)


def _reached(scene: Scene, cameras: Cameras, view: int, mask: torch.Tensor) -> torch.Tensor:
    """[N] bool: the box around alpha >= 1/255, made larger by a pixel, meets the pixel centres of a marked tile."""
    means, conics, _, depths, opacities = project(scene.map(torch.Tensor.double), cameras, view)
    reach = 2 * torch.log(opacities / ALPHA_CUT)
    half = (reach[:, None].clamp_min(0) * torch.linalg.inv(conics).diagonal(dim1=1, dim2=2)).sqrt() + 1
    found = torch.zeros(len(means), dtype=torch.bool)
    for row, column in mask.nonzero().tolist():
        # A tile at the image's edge counts whole: renderers draw blocks of pixels.
        first = torch.tensor([column, row], dtype=torch.float64) * TILE + 0.5
        found |= ((means + half >= first) & (means - half <= first + TILE - 1)).all(1)
    return found & (depths > cameras.near_plane) & (reach >= -0.01)


@check("renderer")
def check_renderer_session(part: Renderer) -> None:
    """A session whose active rows changed shows what a fresh render of the whole shows, with the same gradients."""
    case = get_case("cloud")
    active = torch.arange(0, len(case.gaussians), 9)
    changed = _next(case.gaussians, active)
    weights = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(2))
    for view in range(len(case.cameras)):
        session = part.open(case.gaussians, None, case.cameras, GREY)
        still = session.render(view, case.gaussians).image.detach().clone()
        equal(
            "wide session, nothing changed",
            still,
            _draw(part, case.gaussians, case.cameras, view).image,
            tolerance=1e-6,
            why=SUMS,
        )
        session.narrow(active)
        rows = changed.rows(active).map(lambda v: v.detach().clone().requires_grad_())
        whole = changed.map(lambda v: v.detach().clone().requires_grad_())
        got, want = session.render(view, rows), part.render(whole, case.cameras, view, GREY)
        equal(f"camera {view}: image", got.image.detach(), want.image.detach(), tolerance=1e-5, why=SUMS)
        if got.tiles is not None:
            tiles = got.tiles.repeat_interleave(16, 0).repeat_interleave(16, 1)[:SIZE, :SIZE]
            equal(
                f"camera {view}: outside the tiles named",
                got.image.detach()[~tiles],
                still[~tiles],
                tolerance=1e-6,
                why=SUMS,
            )
        for output in (got, want):
            (output.image * weights).sum().backward()  # type: ignore[no-untyped-call]
        a, b = (dict(each.items()) for each in (rows.map(gradient_of), whole.map(gradient_of).rows(active)))
        gradients_equal(f"camera {view}", a, b, tolerance=1e-4, why=SUMS)


@check("renderer")
def check_renderer_commit(part: Renderer) -> None:
    """After ``commit`` a session is, bit for bit, one opened anew with the next scene."""
    case = get_case("cloud")
    active = torch.arange(0, len(case.gaussians), 9)
    later = _next(case.gaussians, active)
    session = part.open(case.gaussians, None, case.cameras, GREY)
    weights = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        for view in range(len(case.cameras)):
            session.screen_gradient(view, weights)
        session.narrow(active)
        for view in range(len(case.cameras)):
            session.render(view, later.rows(active))
    kept, fresh = session.commit(later, active), part.open(later, None, case.cameras, GREY)
    others = torch.arange(4, len(later), 11)
    last = _next(later, others)
    for view in range(len(case.cameras)):
        a, b = (each.screen_gradient(view, weights) for each in (kept, fresh))
        first = torch.zeros(-(-SIZE // TILE), -(-SIZE // TILE), dtype=torch.bool)
        first[0] = True
        seen, expected = (each.visible(view, first) for each in (kept, fresh))
        equal(f"camera {view}: visible in the upper tiles", seen, expected)
        # Sums of gradients may run in no fixed order; images may not differ.
        relative(f"camera {view}: screen gradient", a.gradient, b.gradient, tolerance=1e-5, why=SUMS, floor=0.1)
    for each in (kept, fresh):
        each.narrow(others)
    for view in range(len(case.cameras)):
        with torch.no_grad():
            a_image, b_image = (each.render(view, last.rows(others)).image for each in (kept, fresh))
        equal(f"camera {view}: image", a_image, b_image)
