"""What a renderer promises of the change between two frames: the tiles, rows and differences of the torch body."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsstream.core.cameras import Cameras
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.change import Change, find_change
from gsstream.testing.cases import BLACK, get_case
from gsstream.testing.compare import EXACT, at_most, equal
from gsstream.testing.registry import check

THRESHOLD = 6.0
SIZES = ((64, 80), (37, 49), (3, 5), (1, 1), (16, 16), (9, 130))
KINDS = ("still", "noise", "flash", "moved", "black to white")


def pictures(kind: str, height: int, width: int, stored: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an image before and after a change of this kind, both [H, W, 3] as they are stored."""
    g = torch.Generator().manual_seed(height * width)
    before = torch.rand(height, width, 3, generator=g)
    noisy = before + torch.randn(before.shape, generator=g) / 255
    now = {"noise": noisy, "flash": before * 1.2, "moved": noisy}.get(kind, before).clone()
    if kind == "moved":
        now[height // 3 : height // 2, width // 4 : width // 2] += 0.2
    if kind == "black to white":
        before, now = torch.zeros_like(before), torch.ones_like(now)
    if stored == torch.uint8:
        before, now = ((image.clamp(0, 1) * 255).round().to(torch.uint8) for image in (before, now))
    return before, now


def pairs(height: int, width: int) -> Iterator[tuple[str, tuple[torch.Tensor, torch.Tensor]]]:
    """Yield every kind of change of images of this size, stored as float32, as bytes, and as one of each."""
    for kind in KINDS:
        floats, codes = (pictures(kind, height, width, stored) for stored in (torch.float32, torch.uint8))
        yield f"{kind}, float32", floats
        yield f"{kind}, bytes", codes
        yield f"{kind}, one of each", (codes[0], floats[1])


@check("renderer")
def check_renderer_change(part: Renderer) -> None:
    """The tiles that changed, and the differences in them, are those of the default body, bit for bit."""
    for height, width in SIZES:
        for what, (before, now) in pairs(height, width):
            found, want = part.find_change([before], [now], THRESHOLD), find_change([before], [now], THRESHOLD)
            where = f"{what}, {width} x {height}"
            equal(f"{where}: tiles", found.tiles, want.tiles)
            equal(f"{where}: tiles and those beside them", found.dilated, want.dilated)
            equal(f"{where}: difference", found.difference(0, now, before), want.difference(0, now, before))
            values = torch.rand(height, width, 3)
            equal(f"{where}: values", found.only_changed(0, values), want.only_changed(0, values))


@check("renderer")
def check_renderer_changed_rows(part: Renderer) -> None:
    """Votes and rows are those of the default body, but for a centre on the border of a tile."""
    case = get_case("cloud")
    cameras = case.cameras.scaled(100, 75)
    scene = case.gaussians.rows(torch.arange(0, len(case.gaussians), 3))
    found, want = _changed(part, cameras)
    means = torch.cat([scene.means, 20 * torch.randn(300, 3, generator=torch.Generator().manual_seed(5))])
    votes, wanted = found.votes(means, cameras), want.votes(means, cameras)
    at_most("centres with other votes", (votes != wanted).sum(), 1, tolerance=0, why="a centre on the border of a tile")
    session = part.open(scene, None, cameras, BLACK)
    for moved in (scene.means, scene.means + 0.01):
        rows, asked = found.rows(moved, cameras, session, 0.5), session.visible_anywhere(want.tiles)
        expected = asked & (found.votes(moved, cameras) >= 0.5)
        equal("rows that changed", rows, expected)
    equal("tiles, after all that", found.tiles, want.tiles)
    none = part.find_change(*2 * ([torch.zeros(75, 100, 3)] * len(cameras),), THRESHOLD)
    rows = none.rows(scene.means, cameras, session, 0.0)
    at_most("rows where nothing changed", rows.sum(), 0, tolerance=0, why=EXACT)


def _changed(part: Renderer, cameras: Cameras) -> tuple[Change, Change]:
    """The same change found by the renderer and by the default body: a third of the picture, elsewhere in each view."""
    before = [torch.zeros(cameras.height, cameras.width, 3)] * len(cameras)
    now = [image.clone() for image in before]
    for view, image in enumerate(now):
        image[:, 30 * view : 30 * view + 30] = 0.5
    return part.find_change(before, now, THRESHOLD), find_change(before, now, THRESHOLD)
