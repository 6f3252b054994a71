"""Pictures of the browser and of the Python player, and how far they are apart."""

from __future__ import annotations

import base64

import numpy as np

from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render, to_bytes
from gsstream.player.software import render_numpy


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    error = np.mean((first.astype(np.float64) - second) ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def decoded(text: str, width: int, height: int) -> np.ndarray:
    """RGB [height, width, 3] from base64 of RGBA bytes."""
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)[..., :3]


def drawn(playback: Playback, frame: int, background: tuple[float, float, float] | None = None) -> np.ndarray:
    """A frame from the first test camera by the player's reference renderer, 8 bits."""
    renderer = PlayerRenderer("numpy", render_numpy)
    scene = playback.state_at(frame)
    colour = playback.meta.background if background is None else background  # in the light of this frame
    return to_bytes(render(scene, playback.cameras("test"), 0, colour, renderer))
