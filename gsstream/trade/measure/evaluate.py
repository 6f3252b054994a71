"""Quality of decoded frames: what the player shows, against the recording, and against showing frame 0 for ever."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.shapes import FloatArray
from gsstream.metrics import SSIM_VARIANT, OnnxLpips, moving_mask, noise_sigma, psnr, slope_per_100, ssim
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, find_renderer, render
from gsstream.source.base import FrameSource
from gsstream.trade.measure.records import mean
from gsstream.trade.measure.summary import format_table


@dataclass(frozen=True, slots=True)
class ViewPair:
    """What an extra metric is given: one test camera at one frame, [H, W, 3] in [0, 1], and the frame before it.

    Arguments:
        last_image, last_truth: of the evaluated frame before; None at the first.
        sigma: noise of one recorded image.
    """

    image: FloatArray
    truth: FloatArray
    last_image: FloatArray | None
    last_truth: FloatArray | None
    sigma: float


#: An extra metric of one view; nan where it is not defined.
ViewMetric = Callable[[ViewPair], float]


@dataclass(frozen=True, slots=True)
class ViewQuality:
    """One test camera at one frame; dB, SSIM, LPIPS; nan where nothing moves or not measured, inf for equal images.

    ``extra``: name -> value of what was asked for besides.
    """

    frame: int
    camera: str
    psnr: float
    ssim: float
    psnr_moving: float
    moving_share: float
    hold_psnr: float
    hold_ssim: float
    hold_psnr_moving: float
    lpips: float = math.nan
    hold_lpips: float = math.nan
    extra: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All views of all frames.

    Arguments:
        views: in the order of frames, then cameras.
        sigmas: camera -> noise of one image, [0, 1] units.
        renderer: name of the player's renderer.
        lpips_variant: which LPIPS was measured; None: none, and neither table nor JSON speak of it.
    """

    views: tuple[ViewQuality, ...]
    sigmas: Mapping[str, float]
    renderer: str
    lpips_variant: str | None = None

    def series(self, name: str) -> dict[int, float]:
        """Return frame -> mean over cameras of a quantity of :class:`ViewQuality`, over views where it is finite."""
        frames = sorted({view.frame for view in self.views})
        return {t: mean(getattr(v, name) for v in self.views if v.frame == t) for t in frames}

    def to_json(self) -> str:
        """Return everything as JSON; nan and inf become null."""
        unknown = ("extra",) if self.lpips_variant else ("lpips", "hold_lpips", "extra")
        views = [{k: _plain(v) for k, v in asdict(view).items() if k not in unknown} for view in self.views]
        for row, view in zip(views, self.views, strict=True):
            row |= {name: _plain(value) for name, value in view.extra.items()}
        variants = {"ssim_variant": SSIM_VARIANT}
        if self.lpips_variant:
            variants["lpips_variant"] = self.lpips_variant
        data = {**variants, "renderer": self.renderer, "sigmas": dict(self.sigmas), "views": views}
        return json.dumps(data, indent=1, allow_nan=False)

    def table(self) -> str:
        """Return a Markdown table of the decoded stream and of frame 0 held still.

        Columns: frame 0, mean of later frames, slope, SSIM, moving pixels, LPIPS if measured.
        """
        names, forms = ["ssim", "psnr_moving"], [".2f", ".2f", "+.2f", ".4f", ".2f"]
        rows = [["", "PSNR 0", "PSNR", "dB/100", "SSIM", "moving"]]
        if self.lpips_variant:
            names, forms, rows = [*names, "lpips"], [*forms, ".4f"], [[*rows[0], "LPIPS"]]
        for label, prefix in (("decoded", ""), ("frame 0 held", "hold_")):
            whole = self.series(prefix + "psnr")
            (first, psnr_first), later = next(iter(whole.items())), dict(list(whole.items())[1:])
            known = {t: v for t, v in later.items() if math.isfinite(v)}
            slope = slope_per_100(list(known), list(known.values()))
            rest = [mean(v for t, v in self.series(prefix + n).items() if t != first) for n in names]
            numbers = [psnr_first, mean(known.values()), slope, *rest]
            cells = zip(numbers, forms, strict=True)
            rows.append([label, *(format(v, form) if math.isfinite(v) else "-" for v, form in cells)])
        variants = "; ".join(filter(None, (SSIM_VARIANT, self.lpips_variant)))
        notes = f"{variants}; renderer {self.renderer}; means over cameras, then over frames 1..T-1"
        return f"{format_table(rows)}\n\n{notes}"


def evaluate(
    stream: str | os.PathLike[str], source: FrameSource, *, frames: Sequence[int] | None = None,
    split: Literal["train", "test"] = "test", renderer: PlayerRenderer | None = None,
    lpips: OnnxLpips | None = None, extras: Mapping[str, ViewMetric] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:  # fmt: skip
    """Render a stream's packets with the player and compare every test view with the recording.

    Colours are clamped to [0, 1] first, as a screen would (3DGS convention). Noise is measured between the first two
    evaluated frames; "moving" is relative to the first evaluated frame, which is also the one held.

    Arguments:
        stream: file to read.
        source: an open recording.
        split: "test" or "train".
        renderer: that draws.
        frames: frame indices; default all of the stream.
        lpips, extras: measured besides the rest; default: not measured.
        progress: called with (done, total) after every frame.

    Raises InputError when the recording's cameras are not those of the stream, PacketError for a damaged stream.
    """
    renderer = find_renderer() if renderer is None else renderer
    with Playback(stream) as playback:
        rig = playback.cameras(split)
        chosen = sorted(set(playback.frames if frames is None else frames))
        if not chosen or len(rig) == 0:
            raise InputError(f"nothing to evaluate: {len(chosen)} frames, {len(rig)} {split} cameras")
        order = _match(rig, source.info.test if split == "test" else source.info.train, split)
        truth_first = _truth(source, chosen[0], split, order)
        truth_next = _truth(source, chosen[1], split, order) if len(chosen) > 1 else truth_first
        sigmas = [noise_sigma(a, b) for a, b in zip(truth_first, truth_next, strict=True)]
        held = _rendered(playback, chosen[0], rig, renderer)
        scene, images, views = playback.state_at(chosen[0]), held, []
        last: tuple[Sequence[FloatArray | None], Sequence[FloatArray | None]] = ([None] * len(rig), [None] * len(rig))
        for done, frame in enumerate(chosen, 1):
            if playback.state_at(frame) is not scene:
                scene, images = playback.state_at(frame), _rendered(playback, frame, rig, renderer)
            truth = _truth(source, frame, split, order)
            for i, name in enumerate(rig.ids):
                mask = moving_mask(truth[i], truth_first[i], sigmas[i])
                pair = ViewPair(images[i], truth[i], last[0][i], last[1][i], sigmas[i])
                found = {key: metric(pair) for key, metric in (extras or {}).items()}
                views.append(replace(_compare(frame, name, pair, held[i], mask, lpips), extra=found))
            last = (images, list(truth))
            if progress is not None:
                progress(done, len(chosen))
    variant = None if lpips is None else lpips.variant
    return Evaluation(tuple(views), dict(zip(rig.ids, sigmas, strict=True)), renderer.name, variant)


def _compare(
    frame: int, name: str, pair: ViewPair, held: FloatArray, mask: Any, lpips: OnnxLpips | None
) -> ViewQuality:
    image, truth = pair.image, pair.truth
    distances = () if lpips is None else (lpips(image, truth), lpips(held, truth))
    return ViewQuality(
        frame, name, psnr(image, truth), ssim(image, truth), psnr(image, truth, mask), float(mask.mean()),
        psnr(held, truth), ssim(held, truth), psnr(held, truth, mask), *distances,
    )  # fmt: skip


def _rendered(playback: Playback, frame: int, rig: Cameras, renderer: PlayerRenderer) -> list[FloatArray]:
    scene, background = playback.state_at(frame), playback.meta.background
    return [np.clip(render(scene, rig, view, background, renderer), 0, 1) for view in range(len(rig))]


def _truth(source: FrameSource, frame: int, split: Literal["train", "test"], order: Sequence[int]) -> FloatArray:
    return source.frame(frame, split).images[list(order)]


def _match(rig: Cameras, recorded: Cameras, split: str) -> list[int]:
    """Index in the recording of every camera of the stream."""
    missing = [name for name in rig.ids if name not in recorded.ids]
    if missing or (rig.width, rig.height) != (recorded.width, recorded.height):
        raise InputError(
            f"the recording does not fit the stream: expected {split} cameras {list(rig.ids)} at {rig.width} x "
            f"{rig.height}, got {list(recorded.ids)} at {recorded.width} x {recorded.height}; "
            "open the recording at the scale of the run"
        )
    return [recorded.ids.index(name) for name in rig.ids]


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
