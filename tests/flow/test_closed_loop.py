"""player(packets) == encoder state, bit for bit; and what is rendered on both sides is the same picture."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from flow_runs import WORLD, Witness, arguments, demo_copy, encode, growing, metrics, without_test_cameras
from growing_plugin import growth_installed
from residual_oracle import train_rows

from gsstream.cli.main import run_command
from gsstream.core.changes import Delta, Scene, apply_delta
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.rng import Rng
from gsstream.engine.run.player_difference import difference_between
from gsstream.engine.step import frame_step as step_module
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.motion.rigid import Rigid
from gsstream.parts.render.work import FitContext
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, find_renderer, render
from gsstream.player.software import render_numpy

METHODS = ["dense", "s2gs-edge"]


def same_bits(ours, theirs) -> None:
    """Bits, because every packet is a difference to this state: what is a rounding here adds up over the frames."""
    for (name, a), (_, b) in zip(ours.items(), theirs.items(), strict=True):
        assert a.dtype == b.dtype == np.float32, name
        assert a.shape == b.shape, name
        assert a.tobytes() == b.tobytes(), name


class Run(NamedTuple):
    """How a run is made; ``shows``: whether its metrics hold what the row is about."""

    method: str = "s2gs-edge"
    settings: dict[str, Any] = {}  # noqa: RUF012 (never written)
    flags: tuple[str, ...] = ()
    grows: bool = False
    shows: Callable[[list[dict[str, Any]]], bool] = lambda lines: len(lines) == 6


#: Gaussians that are far behind everything take no part in motions or growth.
GROWING = {
    "growth": "neighbours",
    "growth__per_frame": 40,
    "first_frame__shell": True,
    "background": "auto",
}
RUNS = {
    "dense": Run("dense"),
    "s2gs-edge": Run(),
    "rows come and go": Run("dense", grows=True, shows=lambda lines: _counts(lines) == [10, 0, 10, 0, 10]),
    "rows come and go behind shared gates": Run(grows=True, shows=lambda lines: _counts(lines) == [10, 0, 10, 0, 10]),
    "growing and rigid": Run(
        settings={**GROWING, "motion": "rigid", "motion__epochs": 1},
        shows=lambda lines: _any(lines, "moving_groups") and _any(lines, "added_gaussians"),
    ),
    "trimmed": Run(
        flags=("--budget", "size=300B"),
        shows=lambda lines: any("symbols" in line["budget"]["reduced"] for line in lines[1:]),
    ),
}


def _counts(lines: list[dict[str, Any]]) -> list[int]:
    return np.diff([line["num_gaussians"] for line in lines]).tolist()


def _any(lines: list[dict[str, Any]], key: str) -> bool:
    return any(line[key] > 0 for line in lines[1:])


@pytest.mark.parametrize("row", RUNS)
def test_the_player_has_the_encoders_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: str) -> None:
    """What later frames are predicted from, displacements, groups and decoders, is the same on both ends too."""
    run, witness = RUNS[row], Witness(monkeypatch)
    if run.grows:
        growing(monkeypatch, run.method)
    with growth_installed(tmp_path):
        encode(tmp_path, *run.flags, method=run.method, **run.settings)
    assert run.shows(metrics(tmp_path)), "what the row is about did not happen: it proves too little"
    with Playback(tmp_path / "stream.gss") as playback:
        assert list(playback.frames) == list(range(6))
        changed = 0
        for frame, state in enumerate(witness.states):
            theirs = playback.player_state(frame)
            assert difference_between(theirs, state.player) == ""
            state.hierarchy.validate()
            np.testing.assert_array_equal(state.hierarchy.node_of.numpy(), theirs.layout.node_of)
            assert set(state.player.decoders) == set(theirs.decoders)
            for name, decoder in theirs.decoders.items():
                assert state.decoders[name].numpy().tobytes() == decoder.tobytes(), name
            if frame:
                before = witness.states[frame - 1].player.gaussians.means
                changed += theirs.gaussians.means.tobytes() != before.tobytes()
        assert row == "trimmed" or changed >= 3, "a stream in which nothing changes proves nothing"
        # Out of order: what is shown of a frame does not depend on what was shown before.
        for frame in (4, 1, 5, 0):
            same_bits(witness.states[frame].player.gaussians, playback.state_at(frame))
    assert run_command(["info", str(tmp_path / "stream.gss")]) == 0


@pytest.mark.parametrize("method", METHODS)
def test_both_sides_show_the_same_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """The player's renderers on decoded packets equal the reference on the encoder's state, at the same near plane."""
    witness = Witness(monkeypatch)
    encode(tmp_path, "--frames", "4", method=method)
    state = witness.states[-1]
    with Playback(tmp_path / "stream.gss") as playback:
        cameras, scene = playback.cameras("test"), playback.state_at(3)
        assert cameras.near_plane == state.previous.cameras.near_plane != 0.01, "the packet has the near plane"
        fast = find_renderer()
        assert fast.name == "cpu"
        for renderer in (fast, PlayerRenderer("numpy", render_numpy)):
            shown = render(scene, cameras, 0, playback.meta.background, renderer)
            exact = ReferenceRenderer().render(state.gaussians, cameras, 0, playback.meta.background).image
            difference = np.abs(shown - exact.numpy())
            # Where a Gaussian's alpha lies at the cut of 1/255 to the last bit, one draws it and the other does not.
            assert np.quantile(difference, 0.999) < 2e-5, renderer.name
            assert difference.max() < 1 / 255, renderer.name
        again = render(state.player.gaussians, cameras, 0, playback.meta.background, fast)
        assert again.tobytes() == render(scene, cameras, 0, playback.meta.background, fast).tobytes()


def test_training_and_transmission_apply_the_same_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's forward on the hardened solution equals the decoded packet up to rounding: what was trained is sent."""
    seen = []

    def harden(parts, problem, solution):
        residual = original(parts, problem, solution)
        share = torch.from_numpy(residual.gates.astype(np.float32) / residual.num_levels)
        gates = share[problem.hierarchy.node_of][problem.rows]
        units = torch.from_numpy(problem.layout.units_of(problem.rows.numpy()))
        rows = train_rows(parts.update, problem.base, gates, solution.latents, solution.decoders, units)
        seen.append((problem, residual, rows))
        return residual

    original = step_module.quantise_residual
    monkeypatch.setattr(step_module, "quantise_residual", harden)
    witness = Witness(monkeypatch)
    keep = {"motion": "still", "codec__trim": 0, "stream__change_threshold": 0}
    encode(tmp_path, "--frames", "4", method="s2gs-edge", **keep)
    assert len(seen) == 3
    for frame, (problem, residual, rows) in enumerate(seen, 1):
        before = witness.states[frame - 1].player.scene
        sent = apply_delta(before, Delta((residual,))).gaussians
        active = problem.rows.numpy()
        assert residual.gates.any()
        for name in ATTRIBUTES:
            trained, decoded = getattr(rows, name).numpy(), getattr(sent, name)[active]
            # Decoders travel as half floats: the only difference between the two, beside the order of sums.
            step = np.abs(decoded - getattr(problem.base, name).numpy()).max(initial=0)
            np.testing.assert_allclose(trained, decoded, atol=2e-3 * step + 1e-6, rtol=0, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_one_camera_one_frame_no_colour_bands_no_test_camera(tmp_path: Path, method: str) -> None:
    folder = demo_copy(tmp_path / "r", train=1, frames=1, edit=without_test_cameras)
    out = tmp_path / "o"
    encode(out, source=str(folder), method=method, scale=0.4, first_frame__sh_degree=0, pictures=True)
    (line,) = metrics(out)
    assert line["status"] == "key"
    assert "psnr" not in line
    with Playback(out / "stream.gss") as playback:
        scene = playback.state_at(0)
        assert scene.shN.shape == (len(scene), 0, 3)
        assert len(playback.cameras("test")) == 0
        assert render(scene, playback.cameras("train"), 0).max() > 0.1
    assert (out / "contact_sheet.png").exists()


def test_training_never_sees_test_cameras(tmp_path: Path) -> None:
    """Other test images: the same stream, other measurements."""
    honest, spoiled = demo_copy(tmp_path / "a"), demo_copy(tmp_path / "b")
    for path in (spoiled / "cam03").iterdir():
        path.write_bytes((spoiled / "cam08" / path.name).read_bytes())
    streams = []
    for folder in (honest, spoiled):
        out = tmp_path / f"out-{folder.name}"
        # The stream names its source; both runs go by the same path, so that nothing else differs.
        link = tmp_path / "recording"
        link.unlink(missing_ok=True)
        link.symlink_to(folder)
        streams.append(encode(out, source=str(link), method="s2gs-edge", scale=0.4))
    assert streams[0] == streams[1]
    first, second = (metrics(tmp_path / f"out-{name}")[1]["psnr"]["cam03"] for name in "ab")
    assert first != second


def test_the_run_folder_is_complete(tmp_path: Path) -> None:
    out = tmp_path / "o"
    encode(out, "--frames", "3", method="s2gs-edge", pictures=True)
    assert {path.name for path in out.iterdir()} == {
        "stream.gss",
        "metrics.jsonl",
        "recipe.yaml",
        "recording.txt",
        "contact_sheet.png",
        "frames.png",
        "summary.txt",
    }
    size = (out / "stream.gss").stat().st_size
    with Playback(out / "stream.gss") as playback:
        packets = sum(playback.entry(frame).size for frame in playback.frames)
        overhead = size - packets
    lines = metrics(out)
    assert sum(sum(line["bytes"].values()) for line in lines) == packets, "reported bytes are bytes on disk"
    assert 0 < overhead < 100
    for line in lines:
        assert set(line["psnr"]) == set(line["ssim"])
        assert all(value >= 0 for value in line["seconds"].values())
        assert line["num_gaussians"] > 0
        assert line["peak_memory_mb"] > 0


def test_without_pictures_a_run_is_the_same_and_they_can_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, pictures = tmp_path / "o", {"contact_sheet.png", "frames.png"}
    with monkeypatch.context() as patch:
        for name in ("matplotlib.figure", "gsstream.evaluation.contact_sheet", "gsstream.player.play"):
            patch.setitem(sys.modules, name, None)  # importing it anywhere fails
        without = encode(out, "--frames", "3", method="s2gs-edge")
    names = {path.name for path in out.iterdir()}
    assert names == {"stream.gss", "metrics.jsonl", "recipe.yaml", "recording.txt", "summary.txt"}
    recipe = (out / "recipe.yaml").read_bytes()
    assert encode(out, "--frames", "3", "--resume", method="s2gs-edge", pictures=True) == without
    assert {path.name for path in out.iterdir()} == names | pictures
    assert (out / "recipe.yaml").read_bytes() == recipe
    sheet = (out / "contact_sheet.png").read_bytes()
    encode(out, "--frames", "3", "--resume", method="s2gs-edge")
    assert (out / "contact_sheet.png").read_bytes() == sheet, "what is there stays"


def test_a_run_repeats_from_its_saved_recipe(tmp_path: Path) -> None:
    first = encode(tmp_path / "a", "--frames", "2", method="s2gs-edge")
    again = ["run", "--source", WORLD, "--recipe", str(tmp_path / "a" / "recipe.yaml"), "--out", str(tmp_path / "b")]
    assert run_command([*again, "--quiet", "--no-pictures"]) == 0
    assert (tmp_path / "b" / "stream.gss").read_bytes() == first


SPOILED = {
    "another type": (lambda motion: [motion], "expected a tuple of Motion or Field, got list"),
    "numbers": (lambda motion: (motion.symbols,), "expected a tuple of Motion"),
    "too few groups": (lambda motion: (replace(motion, moving=motion.moving[:-1]),), "expected"),
    "too few symbols": (lambda motion: (replace(motion, symbols=motion.symbols[:-1]),), "symbols: expected"),
    "symbols of halves": (lambda motion: (replace(motion, symbols=motion.symbols + 0.5),), "expected int32, got"),
    "no cell": (lambda motion: (replace(motion, cell=float("nan")),), "cell: expected a float32 above 0"),
    "a cell of zero": (lambda motion: (replace(motion, cell=0.0),), "cell: expected a float32 above 0"),
    "no brightness bins": (lambda motion: (replace(motion, brightness_bins=0),), "brightness_bins: expected 1 to 16"),
    "beyond everything": (
        lambda motion: (replace(motion, symbols=np.full_like(motion.symbols, 2**31 - 1), translation_step=9e8),),
        "motion",
    ),
    "too many": (lambda motion: (motion,) * 9, "at most 8 motions"),
}  # fmt: skip


#: Of the runs that are spoiled, and of the one that is not.
MOVING = {"method": "s2gs-edge", "motion": "rigid", "motion__epochs": 1, "motion__hold": 0.1, "stream__epochs": 1}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, bytes]:
    """The folder of a run as it is when the first group moves after frame 1, that frame, and the undisturbed stream."""
    folder = tmp_path_factory.mktemp("undisturbed")
    begun, frame, sound = folder / "begun", list[int](), Rigid.propose

    def propose(self: Rigid, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> Any:
        found = sound(self, scene, work, rng)
        if work.index > 1 and found and found[0].moving.any() and not begun.exists():
            shutil.copytree(folder / "run", begun)
            frame.append(work.index)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Rigid, "propose", propose)
        whole = encode(folder / "run", "--frames", "4", **MOVING)
        return begun, frame[0], whole


@pytest.mark.parametrize("how", SPOILED)
def test_a_motion_that_does_not_fit_ends_in_one_sentence(
    undisturbed: tuple[Path, int, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    """Nothing written is lost, and with the part mended the run goes on to the bytes of an undisturbed one."""
    spoil, message = SPOILED[how]
    sound = Rigid.propose
    begun, frame, whole = undisturbed
    run = shutil.copytree(begun, tmp_path / "run")

    def propose(self: Rigid, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> Any:
        found = sound(self, scene, work, rng)
        return spoil(found[0]) if found else found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Rigid, "propose", propose)
        assert run_command(arguments(run, "--resume", "--frames", "4", **MOVING)) == 1
    err = capsys.readouterr().err
    # The second line says what there is and how to go on.
    assert len([line for line in err.splitlines() if not line.startswith("the stream in ")]) == 1, err
    assert err.startswith(f"error: motion 'Rigid' (from gsstream) failed at frame {frame}: ")
    assert message in err
    with Playback(run / "stream.gss") as playback:
        assert list(playback.frames) == list(range(frame))
    assert len(metrics(run)) == frame
    if how != "numbers":
        return  # to the stream and to those who resume it, all of these are the same
    assert encode(run, "--resume", "--frames", "4", **MOVING) == whole
