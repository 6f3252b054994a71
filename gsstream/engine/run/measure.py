"""Quality of decoded frames on held-out cameras, measured while a run goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.shapes import FloatArray
from gsstream.metrics import changed_mask, moving_mask, noise_sigma, picture_quality, psnr
from gsstream.metrics.picture_quality import PictureQuality
from gsstream.packet import PlayerState
from gsstream.parts.backend.base import Renderer

#: Held-out PSNR of frame 0 below which training views are looked at, and how far it may lie below theirs, dB.
LOW_PSNR_DB, MAX_DROP_DB = 20.0, 4.0
#: Training views that are looked at.
MAX_TRAIN_VIEWS = 4
#: Factor by which a test camera may become brighter or darker beside what is drawn for it, before that is said.
OUT_OF_LIGHT = 1.2


class HeldOut:
    """Renders the decoded scene for the test cameras and compares the renders with their images.

    Moving pixels are those that differ from frame 0 beyond the camera's noise; the noise is measured once, between the
    first two frames.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._first: Frame | None = None
        self._sigma: list[float] = []
        #: Test camera -> brightness of its picture and of the drawn one, in the first frame and in the last.
        self._light: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._told: set[str] = set()

    def measure(self, player: PlayerState, frame: Frame) -> dict[str, Any]:
        """Return PSNR, SSIM and PSNR of moving and changed pixels by test camera; None where undefined."""
        if self._first is None:
            self._first = frame
        elif not self._sigma:
            self._sigma = _noise(self._first, frame)
        out: dict[str, Any] = {name: {} for name in PictureQuality._fields}
        for view, name in enumerate(frame.cameras.ids):
            image = self.render(player, frame, view)
            truth, first = frame.image(view), self._first.image(view)
            light = np.array([truth.mean(), image.mean()]).clip(1e-3)
            self._light[name] = self._light.get(name, (light,))[0], light
            moving = moving_mask(truth, first, self._sigma[view]) if self._sigma else np.zeros(truth.shape[:2], bool)
            quality = picture_quality(image, truth, moving, changed=changed_mask(truth, first))
            for key, value in quality._asdict().items():
                out[key][name] = value if math.isfinite(value) else None
        return out

    def doubt(self, player: PlayerState, train: Frame, measured: Mapping[str, float | None]) -> str:
        """Return a warning when frame 0 fits the training cameras and not the held-out cameras."""
        held_out = [value for value in measured.values() if value is not None]
        if not held_out or float(np.mean(held_out)) >= LOW_PSNR_DB:
            return ""
        views = np.unique(np.linspace(0, len(train.cameras) - 1, MAX_TRAIN_VIEWS).round().astype(int))
        seen = float(np.mean([psnr(self.render(player, train, int(view)), train.image(view)) for view in views]))
        below = seen - float(np.mean(held_out))
        if below < MAX_DROP_DB:
            return ""
        return (
            f"held-out cameras show {np.mean(held_out):.1f} dB of frame 0, training cameras {seen:.1f} dB: poses, "
            "lenses or clocks are probably wrong, or the held-out cameras see what no training camera sees"
        )

    def out_of_light(self, frame: int) -> str:
        """Return a warning, once for each test camera, when it gets brighter or darker and what is drawn does not."""
        for name, (first, last) in self._light.items():
            seen, drawn = last / first
            share = seen / drawn
            if name not in self._told and abs(np.log(seen)) > np.log(OUT_OF_LIGHT) < abs(np.log(share)):
                self._told.add(name)
                became = f"{100 * abs(share - 1):.0f} % {'darker' if share < 1 else 'brighter'}"
                return (
                    f"test camera {name} has become {became} than what is drawn for it by frame {frame}: its exposure "
                    "changes, or it is covered, and its numbers say little about the stream"
                )
        return ""

    def remember(self, first: Frame, second: Frame | None) -> None:
        """Keep frame 0, and the noise between the first two frames, from which frames of a resumed run are measured."""
        self._first = first
        if second is not None:
            self._sigma = _noise(first, second)

    def render(self, player: PlayerState, frame: Frame, view: int) -> FloatArray:
        """Return the decoded image [H, W, 3] of a camera, in [0, 1]."""
        gaussians, background = player.gaussians.map(torch.from_numpy), player.meta.background
        with torch.no_grad():
            output = self._renderer.render(gaussians, frame.cameras, view, background)
        return np.asarray(np.clip(output.image.numpy(), 0, 1))


def _noise(first: Frame, second: Frame) -> list[float]:
    """Noise of every camera, image units; empty where the second frame lacks them, because a camera was absent."""
    if second.cameras.ids != first.cameras.ids:
        return []
    return [noise_sigma(first.image(view), second.image(view)) for view in range(len(first.cameras))]
