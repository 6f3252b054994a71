"""A change of colours as symbols: what each is worth against its bits, and the residual that carries them."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Delta, Layout, Residual, sent_rows
from gsstream.core.gaussians import SH0
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet import quantise_decoders

#: Length of one symbol's change of sh0: this many grey levels in each channel.
STEP = 1.5 / 255 / SH0 * 3**0.5
#: The largest symbol, and rounds in which the price of a symbol follows from how often it occurs.
MOST_SYMBOL, ROUNDS = 4, 4


def light_symbols(change: FloatArray, worth: FloatArray, price: float) -> tuple[IntArray, FloatArray]:
    """Return one symbol [N] int32 a row, and the colour [3] that it is a multiple of: squared error plus price of bits.

    The colour is the direction in which the changes, by their worth, are largest.

    Arguments:
        change: [N, 3] of sh0. worth: [N] squared error per square of a change.
        price: squared error that a bit must save.
    """
    _, directions = np.linalg.eigh((change * worth[:, None]).T @ change)
    direction = directions[:, -1] * (1 if directions[:, -1].sum() > 0 else -1) * STEP
    values = np.arange(-MOST_SYMBOL, MOST_SYMBOL + 1)
    along = change @ direction / STEP**2
    bits, chosen = np.where(values == 0, 0.5, 2.0 + np.abs(values)), np.zeros(len(change), np.int64)
    for _ in range(ROUNDS):
        square = values**2 - 2 * along[:, None] * values
        chosen = (worth[:, None] * STEP**2 * square + price * bits).argmin(1)
        counts = np.bincount(chosen, minlength=len(values)) + 0.5
        bits = -np.log2(counts / counts.sum())
    return values[chosen].astype(np.int32), direction.astype(np.float32)


def with_light(
    delta: Delta,
    layout: Layout,
    change: FloatArray,
    worth: FloatArray,
    price: float,
    decoder: FloatArray,
    step: float,
    levels: int,
) -> Delta:
    """Return the delta in which rows behind closed gates change colour, too: a latent more, whose decoder is new.

    Arguments:
        delta: the delta of a frame; its gates stay, and so does what is behind them. layout: the layout of the rows.
        change, worth, price: as :func:`light_symbols` takes them, of all N rows.
        decoder: [L, 3] of sh0, for a delta that has none. step: of its latents. levels: of a gate.
    """
    old = delta.residual or Residual(np.zeros(len(layout.node_counts), np.uint8), levels)
    closed = old.gates == 0
    rows = np.flatnonzero(closed[layout.node_of])
    found = np.zeros(len(change), np.int32)
    found[rows], direction = light_symbols(change[rows], worth[rows], price)
    touched = np.zeros(len(closed), bool)
    touched[layout.node_of[found != 0]] = True
    if not touched.any():
        return delta
    gates = np.where(touched, levels, old.gates).astype(np.uint8)
    sent = sent_rows(layout, gates)
    place = np.searchsorted(sent, sent_rows(layout, old.gates))
    symbols = {}
    for name, value in old.symbols.items():
        symbols[name] = np.zeros((len(sent), value.shape[1]), np.int32)
        symbols[name][place] = value
    colours = symbols.get("sh0", np.zeros((len(sent), len(decoder)), np.int32))
    symbols["sh0"] = np.concatenate([colours, found[sent, None]], axis=1)
    steps = {"sh0": step, **old.steps}
    whole = np.concatenate([old.decoders.get("sh0", decoder), direction[None] / np.float32(steps["sh0"])])
    decoders = {**old.decoders, **quantise_decoders({"sh0": whole})}
    return delta.with_residual(Residual(gates, levels, symbols, steps, decoders))
