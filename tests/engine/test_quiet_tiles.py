"""Which tiles an iteration looks at: all that changed, and of the others a share that stands for all of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from gsstream.cli.main import run_command
from gsstream.engine.step.active.change import Change
from gsstream.engine.step.active.tiles import tile_weights


def draws(share: float, number: int = 4000) -> tuple[torch.Tensor, torch.Tensor]:
    """(tiles that changed or lie beside one [H, W], weights [number, H, W]) of a view in whose corner one changed."""
    tiles, generator = torch.zeros(2, 5, 7, dtype=torch.bool), torch.Generator().manual_seed(1)
    tiles[1, 0, :2] = True
    change = Change(tiles, 80, 112)
    found = [tile_weights(change, 1, share, generator) for _ in range(number)]
    assert all(weights is not None for weights in found)
    return change.dilated[1], torch.stack(found)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.7])
def test_a_quiet_tile_counts_once_on_average(share: float) -> None:
    changed, weights = draws(share)
    assert torch.equal(weights[:, changed], torch.ones_like(weights[:, changed]))
    quiet = weights[:, ~changed]
    assert sorted(quiet.unique().tolist()) == pytest.approx([0, 1 / share])
    # Five standard deviations of the mean of so many draws.
    assert float((quiet.mean(0) - 1).abs().max()) < 5 * ((1 - share) / share / len(quiet)) ** 0.5


def test_no_draw_is_that_of_the_iteration_before() -> None:
    _, weights = draws(0.5, 2)
    assert not torch.equal(weights[0], weights[1])


def test_all_tiles_are_looked_at_where_change_is_not_detected_or_all_are_wanted() -> None:
    generator = torch.Generator().manual_seed(1)
    before = generator.get_state()
    assert tile_weights(None, 0, 0.1, generator) is None
    assert tile_weights(Change(torch.ones(1, 2, 2, dtype=torch.bool), 32, 32), 0, 1.0, generator) is None
    assert torch.equal(generator.get_state(), before), "a draw that is not needed would change streams of before"


def psnr(out: Path, share: float, *more: str) -> float:
    """Mean over the test views of the last of three frames, in which a small body moves before a large wall."""
    sets = [f"stream.static_tile_share={share}", "first_frame.max_iterations=150", "stream.epochs=6"]
    arguments = [part for text in sets for part in ("--set", text)]
    source = "synthetic:frames=3&views=4&width=96&height=64&supersample=1"
    run_command(["run", "--source", source, "--method", "s2gs-edge", "--out", str(out), "--quiet", "--no-pictures",
                 "--no-video", *arguments, *more])  # fmt: skip
    last: dict[str, Any] = json.loads((out / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["status"] == "delta"
    assert 0 < last["changed_tiles"] < 1, "a recording without quiet tiles tests nothing"
    return sum(last["psnr"].values()) / len(last["psnr"])


def test_a_frame_is_as_good_with_few_quiet_tiles_on_either_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tmp_path / "all"
    every = psnr(first, 1.0)
    few = psnr(tmp_path / "few", 0.2, "--first-frame", str(first / "stream.gss"))
    monkeypatch.setenv("GSSTREAM_CHECKS", "step")  # renders, loss and gradient in calls of their own
    slowly = psnr(tmp_path / "slowly", 0.2, "--first-frame", str(first / "stream.gss"))
    assert few == pytest.approx(every, abs=0.3)
    assert slowly == pytest.approx(few, abs=0.05)
