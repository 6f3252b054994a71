"""QUEEN (Girish et al., NeurIPS 2024) as a method of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
import torch

from gsstream.api import (
    AddedGaussians,
    Delta,
    Frame,
    FrameTools,
    Gaussians,
    Layout,
    PlayerState,
    Residual,
    RowEdit,
    Step,
    StreamingMethod,
    Tools,
    quantise_decoders,
    send_delta,
    send_key,
)
from gsstream_queen.change import changed_tiles, gradient_difference
from gsstream_queen.frame import Problem, Result, optimise
from gsstream_queen.gates import initial_logits
from gsstream_queen.latents import coded, initial_weights, weight_of
from gsstream_queen.settings import QueenConfig


@dataclass(frozen=True)
class QueenState:
    """``player``: what every player has. ``previous``: the images its scene shows. ``weights``: of the decoders."""

    player: PlayerState
    previous: Frame
    weights: dict[str, torch.Tensor]


@final
class Queen(StreamingMethod[QueenState]):
    """Every Gaussian has a residual in every frame (paper: Girish et al., NeurIPS 2024).

    Centres move by a direct residual behind a hard-concrete gate of their own; all other attributes by integer latents
    behind linear decoders. Dynamic Gaussians are cloned and split while a frame is optimised. What is sent is a delta
    packet with one node per Gaussian: a Gaussian is open where any of its integers is not zero. Where this differs
    from what is published, and why: README of this plugin.
    """

    source = "QUEEN (Girish et al. 2024)"
    processor_only = "its masks and rows are made by numpy"

    Config = QueenConfig
    recipe_keys = ("stream.epochs",)

    def begin(self, frame: Frame, tools: Tools) -> Step[QueenState]:
        first = tools.first_frame(frame)
        layout = Layout.flat(len(first.gaussians), frame.cameras.extent)
        packet, player = send_key(first.gaussians, layout, first.meta, frame.index)
        return Step(QueenState(player, frame, self._weights(player, tools)), packet, "key")

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> QueenState:
        return QueenState(player, shown, self._weights(player, tools))

    def _weights(self, player: PlayerState, tools: Tools) -> dict[str, torch.Tensor]:
        """Decoders as they were last sent; a decoder that was never sent is as it was drawn."""
        scene = player.gaussians.map(torch.from_numpy)
        policies = coded(self.config.latents(), scene)
        drawn = initial_weights(policies, scene, tools.rng)
        sent = {n: weight_of(n, torch.from_numpy(value)) for n, value in player.decoders.items()}
        return {**drawn, **sent}

    def step(self, state: QueenState, frame: Frame, tools: Tools) -> Step[QueenState]:
        if frame.epoch_scale == 0:
            return self._send(state, frame, tools, Delta())
        work = tools.open(state.player, state.previous, frame)
        with tools.log.phase("confidence"):
            change = gradient_difference(work, self.config.change)
            dynamic = change.difference > self.config.change.dynamic
            active = torch.arange(len(dynamic)) if self.config.rows == "all" else dynamic.nonzero()[:, 0]
        # Without a pixel that differs from the images before there is nothing to learn.
        if not bool((change.difference > 0).any()) or len(active) == 0:
            return self._send(state, frame, tools, Delta())
        with tools.log.phase("optimise"):
            logits = initial_logits(change.difference, change.seen, self.config.gate)[active]
            problem = Problem(
                work=work,
                renderer=tools.renderer,
                background=tools.background,
                active=active,
                dynamic=dynamic,
                masks=self._masks(work, dynamic, tools),
                logits=logits,
                weights=state.weights,
                epochs=tools.epochs(frame),
            )
            result = optimise(self.config, problem, tools.rng.stream("queen", frame.index))
        with tools.log.phase("code"):
            delta = self._harden(state.player, active, result)
            step = self._send(state, frame, tools, delta)
        shifts = None if delta.residual is None else delta.residual.symbols.get("means")
        tools.log.set(
            loss=result.loss,
            iterations=result.iterations,
            dynamic_gaussians=int(dynamic.sum()),
            moved_gaussians=0 if shifts is None else int(shifts.any(1).sum()),
        )
        return step

    def _masks(self, work: FrameTools, dynamic: torch.Tensor, tools: Tools) -> list[torch.Tensor] | None:
        if self.config.mask.share == 0:
            return None
        return changed_tiles(work, dynamic, tools.renderer)

    def _send(self, state: QueenState, frame: Frame, tools: Tools, delta: Delta) -> Step[QueenState]:
        packet, player = send_delta(state.player, delta)
        if delta.is_empty:
            return Step(replace(state, player=player), packet, "empty")
        return Step(QueenState(player, frame, self._weights(player, tools)), packet, "delta")

    def _harden(self, player: PlayerState, active: torch.Tensor, result: Result) -> Delta:
        """The integers of the rows in which any is not zero; rows that leave send none."""
        layout = player.layout
        leaving = result.gone[active].numpy()
        table = {name: np.where(leaving[:, None], 0, value.numpy()) for name, value in result.solution.symbols.items()}
        changed = np.zeros(len(active), bool)
        for value in table.values():
            changed |= value.any(1)
        gates = np.zeros(len(layout.node_counts), np.uint8)
        gates[layout.node_of[active.numpy()[changed]]] = 1
        symbols = {name: value[changed].astype(np.int32) for name, value in table.items() if value.any()}
        steps = {name: self.config.means.step if name == "means" else 1.0 for name in symbols}
        learned = {n: v.numpy() for n, v in result.solution.decoders.items() if n in symbols}
        rows = RowEdit(added_of(result.added, len(layout.node_counts)), np.flatnonzero(result.gone.numpy()))
        return Delta(
            (Residual(gates=gates, num_levels=1, symbols=symbols, steps=steps, decoders=quantise_decoders(learned)),)
        ).with_row_edit(rows)


def added_of(added: Gaussians[torch.Tensor], nodes: int) -> AddedGaussians | None:
    """Return Gaussians to add, each a node of its own after the old nodes; None without any."""
    if len(added) == 0:
        return None
    own = nodes + np.arange(len(added), dtype=np.int64)
    return AddedGaussians(added.map(lambda value: value.numpy()), own, np.zeros(len(added), np.uint8), own)
