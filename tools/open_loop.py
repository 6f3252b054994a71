"""Does a dense stream drift when its encoder does not go on from what players have, or rounds only at the end?

Usage: python -m tools.open_loop --source demo --frames 67 --out DIR [--method dense] [--recipe FILE] [--set
KEY=VALUE ...]

gsstream's encoder rounds in every forward pass and goes on from the frame that it decoded from its own packet. Here the
same method also runs otherwise, all from one frame 0, on a recording that runs there and back again:

    loop     closed: frame t + 1 starts from what a player has of frame t; open: from what was trained, not rounded
    rounding always: in every forward pass; end: only when the packet is written

What players have is measured on the test cameras. Writes DIR/open_loop.json; the streams are valid ones.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.budget.schedule import Schedule
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.recording import open_recording
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step import frame_step
from gsstream.engine.step.optimise import optimise
from gsstream.engine.step.problem import Problem, Solution
from gsstream.input.recordings.base import FrameSource, Split
from gsstream.packet import PlayerState, decode_packet
from gsstream.parts.optimiser.joint import JointChange, add_joint, join_features
from gsstream.parts.update.joint import joint_code
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import Recipe
from tools.drift import Drift, there_and_back

SPLITS: tuple[Split, ...] = ("train", "test")
#: Factor on the steps of residuals that rounds by so little that it is as good as none.
HARDLY = 1e-4


@dataclass(frozen=True)
class Way:
    """How an encoder goes on.

    Arguments:
        open_loop: from what was trained instead of what a player has.
        rounds_at_end: residuals are rounded when the packet is written, and not while they are trained.
    """

    open_loop: bool
    rounds_at_end: bool

    @property
    def name(self) -> str:
        """As in the table."""
        loop, rounding = "open" if self.open_loop else "closed", "at the end" if self.rounds_at_end else "always"
        return f"{loop} loop, rounding {rounding}"


WAYS = tuple(Way(open_loop, at_end) for open_loop in (False, True) for at_end in (False, True))


class Trainer:
    """Stands in for the optimisation of a frame, and keeps what it found before anything was rounded.

    Arguments:
        fine: the update rule with steps that round by next to nothing, or None to train with those of the packet.
    """

    def __init__(self, fine: Any) -> None:
        self._fine, self._optimise = fine, optimise
        self.trained: Gaussians[FloatArray] | None = None
        self._scene: Gaussians[FloatArray] | None = None

    def starts_from(self, scene: Gaussians[FloatArray]) -> None:
        """Say which scene the next frame's residual is added to."""
        self._scene, self.trained = scene, scene

    def optimise(self, parts: Assembly, problem: Problem, schedule: Schedule) -> Solution:
        """Optimise as the engine does, and note the scene with the gates that it found and unrounded residuals."""
        solution = self._optimise(replace(parts, update=self._fine) if self._fine else parts, problem, schedule)
        if solution.latents and self._scene is not None:
            self.trained = _with_residual(self._scene, parts, problem, solution)
        return solution


def _with_residual(
    scene: Gaussians[FloatArray], parts: Assembly, problem: Problem, solution: Solution
) -> Gaussians[FloatArray]:
    """The scene after a solution whose residuals are not rounded; its gates are those that are sent."""
    rows = solution.rows
    base = scene.rows(rows.numpy()).map(torch.from_numpy)
    code = joint_code(parts.update.codes(), solution.latents, solution.decoders, base)
    latents = torch.cat([solution.latents[name] for name in code.latent], 1)
    decoded = latents @ code.join_decoders(solution.decoders)
    if "means" in code.feature:
        decoded[:, code.feature["means"]] *= torch.from_numpy(problem.layout.units_of(rows.numpy()))[:, None]
    gates = parts.gate.sample(solution.logits, None)[problem.hierarchy.node_of[rows]]
    moved = add_joint(code, base, join_features(code, base), JointChange(latents, decoded), gates)
    out = {}
    for name, value in scene.items():
        out[name] = value.copy()
        out[name][rows.numpy()] = getattr(moved, name).numpy()
    return Gaussians(**out)


@dataclass(frozen=True)
class Setting:
    """What all ways of a run share.

    Arguments:
        parts: of the method; fine: its update rule with steps that round by next to nothing.
        source: the recording.
        frames: number of frames, there and back again.
        first: frame 0 of all ways; None for the first of them, which makes it.
    """

    parts: Assembly
    fine: Any
    source: FrameSource
    frames: int
    first: PlayerState | None = None


def run_way(setting: Setting, way: Way) -> tuple[Drift, PlayerState]:
    """Encode and play; return one record per frame, and frame 0 as players have it.

    A record's ``same`` says whether the player's scene equals that which the encoder goes on from.
    """
    records, first = [], setting.first
    for record, player in _frames(setting, way):
        first = first or player
        records.append(record)
    assert first is not None
    return Drift(tuple(records)), first


def _frames(setting: Setting, way: Way) -> Iterator[tuple[dict[str, Any], PlayerState]]:
    parts, source = setting.parts, setting.source
    recipe, held_out = parts.recipe, HeldOut(parts.renderer, parts.recipe.background)
    encoder = Encoder(
        parts, source.info, lambda frame: gather_points(source.points, frame, recipe.first_frame, encoder.rng),
        first_frame=setting.first,
    )  # fmt: skip
    trainer = Trainer(setting.fine if way.rounds_at_end else None)
    player: PlayerState | None = None
    with _trained_by(trainer):
        for index in range(setting.frames):
            at = there_and_back(index, source.info.num_frames or 1)
            train, test = (replace(source.frame(at, split), index=index) for split in SPLITS)
            if encoder.state is not None:
                trainer.starts_from(encoder.state.player.gaussians)
            step = encoder.encode(train)
            player = decode_packet(player, step.packet.data)
            seen = replace(step.state, player=player)
            quality = held_out.measure(seen, encoder.at_near(test))
            if way.open_loop and trainer.trained is not None:
                encoder.state = _going_on_from(step.state, trainer.trained)
            values = {n: [v for v in quality.get(n, {}).values() if v is not None] for n in ("psnr", "psnr_moving")}
            means = {name: float(np.mean(found)) if found else None for name, found in values.items()}
            same = all(
                np.array_equal(value, getattr(player.gaussians, name))
                for name, value in encoder.state.player.gaussians.items()
            )
            yield {"kind": step.status, "bytes": len(step.packet.data), **means, "same": same}, player


@contextmanager
def _trained_by(trainer: Trainer) -> Iterator[None]:
    # The engine has no such switch on purpose: what it encodes is what players have. Here it is the thing examined.
    with mock.patch.object(frame_step, "optimise", trainer.optimise):
        yield


def _going_on_from(state: StreamState, trained: Gaussians[FloatArray]) -> StreamState:
    player = replace(state.player, scene=replace(state.player.scene, gaussians=trained))
    return replace(state, player=player, session=None)


def finer(recipe: Recipe) -> Recipe:
    """Return the recipe with an update rule that rounds by next to nothing."""
    params = {
        name: {**value, "step": value["step"] * HARDLY} if isinstance(value, dict) and "step" in value else value
        for name, value in recipe.update.params.items()
    }
    return recipe.model_copy(update={"update": recipe.update.model_copy(update={"params": params})})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo")
    parser.add_argument("--frames", type=int, default=67)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--method", default="dense")
    parser.add_argument("--recipe", type=Path, action="append", default=[])
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    catalog = load_catalog()
    recipe = resolve_recipe(given.method, catalog.recipe_path, given.recipe, [("--set", text) for text in given.sets])
    parts = assemble(recipe, catalog)
    fine = assemble(finer(parts.recipe), catalog).update
    source = open_recording(given.source, parts.recipe, catalog)
    setting = Setting(parts, fine, source, given.frames)
    found: dict[str, Any] = {}
    period = max(1, 2 * (source.info.num_frames or 1) - 2)
    given.out.mkdir(parents=True, exist_ok=True)
    for way in WAYS:
        drift, first = run_way(setting, way)
        setting = replace(setting, first=first)
        found[way.name] = {"summary": drift.summary(period), "frames": drift.frames}
        summary = found[way.name]["summary"] | {"different_frames": len(drift.different)}
        print(way.name, json.dumps(summary), flush=True)
        (given.out / "open_loop.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
