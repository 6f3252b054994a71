"""Quality of decoded frames: the player's images against the recording, beside those of frame 0 shown for ever."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.evaluation.records import finite_or_none, mean
from gsstream.evaluation.seen import seen_masks
from gsstream.evaluation.summary import format_table
from gsstream.input.recordings.base import Source
from gsstream.metrics import (
    SSIM_VARIANT,
    OnnxLpips,
    changed_mask,
    moving_mask,
    noise_sigma,
    picture_quality,
    psnr,
    slope_per_100,
)
from gsstream.packet import PacketKind
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, find_renderer, render


@dataclass(frozen=True, slots=True)
class ViewPair:
    """What an extra metric is given: one test camera at one frame, [H, W, 3] in [0, 1], and the frame before it."""

    image: FloatArray
    truth: FloatArray
    #: last_image, last_truth: of the evaluated frame before; None at the first.
    last_image: FloatArray | None
    last_truth: FloatArray | None
    sigma: float  # noise of one recorded image


#: An extra metric of one view; nan where it is not defined.
ViewMetric = Callable[[ViewPair], float]


@dataclass(frozen=True, slots=True)
class ViewQuality:
    """One test camera at one frame; dB, SSIM, LPIPS; nan where nothing moves or not measured, inf for equal images.

    ``psnr_changed``: on pixels that differ from the first frame by more than 0.1. ``psnr_seen``,
    ``psnr_changed_seen``: on pixels, and on changed pixels, whose surface at least two training cameras see; nan where
    pictures come without a scene. ``extra``: name -> value of what was asked for besides.
    """

    frame: int
    camera: str
    psnr: float
    ssim: float
    psnr_moving: float
    moving_share: float
    static_psnr: float
    static_ssim: float
    static_psnr_moving: float
    psnr_changed: float = math.nan
    static_psnr_changed: float = math.nan
    lpips: float = math.nan
    static_lpips: float = math.nan
    psnr_seen: float = math.nan
    psnr_changed_seen: float = math.nan
    static_psnr_seen: float = math.nan
    static_psnr_changed_seen: float = math.nan
    seen_share: float = math.nan
    extra: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All views of all frames."""

    views: tuple[ViewQuality, ...]  # in the order of frames, then cameras
    sigmas: Mapping[str, float]  # camera -> noise of one image, [0, 1] units
    renderer: str  # name of the player's renderer
    #: Frames, but the first, whose scene was begun anew by a key packet: across one of them there is no drift.
    later_keys: tuple[int, ...] = ()
    lpips_variant: str | None = None  # which LPIPS was measured; None: none, and neither table nor JSON speak of it

    def series(self, name: str) -> dict[int, float]:
        """Return frame -> mean over cameras of a quantity of :class:`ViewQuality`, over views where it is finite."""
        frames = sorted({view.frame for view in self.views})
        return {t: mean(getattr(v, name) for v in self.views if v.frame == t) for t in frames}

    def to_json(self, protocol: Mapping[str, Any] | None = None) -> str:
        """Return everything as JSON; nan and inf become null. ``protocol``: the numbers of a published protocol."""
        unknown = ("extra",) if self.lpips_variant else ("lpips", "static_lpips", "extra")
        views = [{k: finite_or_none(v) for k, v in asdict(view).items() if k not in unknown} for view in self.views]
        for row, view in zip(views, self.views, strict=True):
            row |= {name: finite_or_none(value) for name, value in view.extra.items()}
        variants = {"ssim_variant": SSIM_VARIANT}
        if self.lpips_variant:
            variants["lpips_variant"] = self.lpips_variant
        data = {**variants, "renderer": self.renderer, "sigmas": dict(self.sigmas), "views": views}
        if protocol is not None:
            data["protocol"] = dict(protocol)
        return json.dumps(data, indent=1, allow_nan=False)

    def table(self) -> str:
        """Return a Markdown table of the decoded stream and of frame 0 held still."""
        quality = {"ssim": "SSIM", "psnr_moving": "moving", "psnr_changed": "changed"}
        if any(math.isfinite(view.seen_share) for view in self.views):
            quality |= {"psnr_seen": "seen", "psnr_changed_seen": "changed, seen"}
        if self.lpips_variant:
            quality["lpips"] = "LPIPS"
        rows = [["", "PSNR 0", "PSNR", "dB/100", *quality.values()]]
        forms = [".2f", ".2f", "+.2f", *(".4f" if name in ("ssim", "lpips") else ".2f" for name in quality)]
        for label, prefix in (("decoded", ""), ("frame 0 held", "static_")):
            whole = self.series(prefix + "psnr")
            (first, psnr_first), later = next(iter(whole.items())), dict(list(whole.items())[1:])
            known = {t: v for t, v in later.items() if math.isfinite(v)}
            slope = slope_per_100(list(known), list(known.values()))
            if prefix == "" and any(first < key <= max(whole) for key in self.later_keys):
                slope = math.nan
            rest = [mean(v for t, v in self.series(prefix + n).items() if t != first) for n in quality]
            numbers = [psnr_first, mean(known.values()), slope, *rest]
            cells = zip(numbers, forms, strict=True)
            rows.append([label, *(format(v, form) if math.isfinite(v) else "-" for v, form in cells)])
        variants = "; ".join(filter(None, (SSIM_VARIANT, self.lpips_variant)))
        notes = f"{variants}; renderer {self.renderer}; means over cameras, then over frames 1..T-1"
        return f"{format_table(rows)}\n\n{notes}"


class Shown(Protocol):
    """Pictures to be compared: of a stream, or of files that another program wrote."""

    @property
    def frames(self) -> Sequence[int]:
        """Indices of frames, in the numbering of the recording."""

    @property
    def rig(self) -> Cameras:
        """The cameras that the pictures are seen from."""

    @property
    def renderer(self) -> str:
        """What drew them."""

    def images(self, frame: int) -> Sequence[FloatArray]:
        """Return a picture [H, W, 3] in [0, 1] for each camera of the rig; the same list where nothing changed."""

    def seen(self, frame: int) -> Sequence[BoolArray] | None:
        """Return [H, W] for each camera: pixels whose surface training cameras see; None where that is not known."""


class StreamFrames:
    """Pictures of a stream as the player shows them."""

    def __init__(self, playback: Playback, rig: Cameras, renderer: PlayerRenderer) -> None:
        self.rig, self.renderer, self.frames = rig, renderer.name, playback.frames
        self._playback, self._with = playback, renderer
        self._last: tuple[Any, list[FloatArray]] | None = None
        self._seen: tuple[Any, list[BoolArray]] | None = None

    def images(self, frame: int) -> list[FloatArray]:
        """Return the pictures of a frame; those of a scene that did not change are not drawn again."""
        scene, background = self._playback.state_at(frame), self._playback.meta.background
        if self._last is None or self._last[0] is not scene:
            views = range(len(self.rig))
            self._last = (
                scene,
                [
                    np.clip(render(scene, self.rig, view, background=background, renderer=self._with), 0, 1)
                    for view in views
                ],
            )
        return self._last[1]

    def seen(self, frame: int) -> list[BoolArray]:
        """Return what training cameras see of the decoded scene, by its own depth."""
        scene = self._playback.state_at(frame)
        if self._seen is None or self._seen[0] is not scene:
            self._seen = (scene, seen_masks(scene, self._playback.cameras("train"), self.rig, self._with))
        return self._seen[1]


def evaluate(
    stream: str | os.PathLike[str],
    source: Source,
    *,
    frames: Sequence[int] | None = None,
    split: Literal["train", "test"] = "test",
    renderer: PlayerRenderer | None = None,
    lpips: OnnxLpips | None = None,
    extras: Mapping[str, ViewMetric] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Render a stream's packets with the player and compare every test view with the recording.

    Raises InputError when the recording's cameras are not those of the stream, PacketError for a damaged stream.
    """
    renderer = find_renderer() if renderer is None else renderer
    with Playback(stream) as playback:
        shown = StreamFrames(playback, playback.cameras(split), renderer)
        keys = [frame for frame in playback.frames if playback.entry(frame).kind == PacketKind.KEY]
        found = evaluate_frames(
            shown, source, frames=frames, split=split, lpips=lpips, extras=extras, progress=progress
        )
    return replace(found, later_keys=tuple(keys[1:]))


def evaluate_frames(
    shown: Shown,
    source: Source,
    *,
    frames: Sequence[int] | None = None,
    split: Literal["train", "test"] = "test",
    lpips: OnnxLpips | None = None,
    extras: Mapping[str, ViewMetric] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Compare pictures of every test view with the recording, clamped to [0, 1] as a screen would (3DGS).

    Noise is measured between the first two evaluated frames; the first is also the one that is held and that "moving"
    and "changed" refer to. Raises InputError when the cameras are not those of the pictures.
    """
    rig, chosen = shown.rig, sorted(set(shown.frames if frames is None else frames))
    if not chosen or len(rig) == 0:
        raise InputError(f"nothing to evaluate: {len(chosen)} frames, {len(rig)} {split} cameras")
    order = _match(rig, source.info.test if split == "test" else source.info.train, split)
    truth_first = _truth(source, chosen[0], split, order)
    truth_next = _truth(source, chosen[1], split, order) if len(chosen) > 1 else truth_first
    sigmas = [noise_sigma(a, b) for a, b in zip(truth_first, truth_next, strict=True)]
    held, views = list(shown.images(chosen[0])), []
    last: tuple[Sequence[FloatArray | None], Sequence[FloatArray | None]] = ([None] * len(rig), [None] * len(rig))
    for done, frame in enumerate(chosen, 1):
        truth, images, seen = _truth(source, frame, split, order), shown.images(frame), shown.seen(frame)
        for i, name in enumerate(rig.ids):
            masks = (moving_mask(truth[i], truth_first[i], sigmas[i]), changed_mask(truth[i], truth_first[i]))
            pair = ViewPair(
                image=images[i], truth=truth[i], last_image=last[0][i], last_truth=last[1][i], sigma=sigmas[i]
            )
            found = {key: metric(pair) for key, metric in (extras or {}).items()}
            quality = _compare(frame, name, pair, held=held[i], masks=masks, lpips=lpips)
            if seen is not None:
                quality = _with_seen(quality, pair, held[i], changed=masks[1], seen=seen[i])
            views.append(replace(quality, extra=found))
        last = (images, list(truth))
        if progress is not None:
            progress(done, len(chosen))
    variant = None if lpips is None else lpips.variant
    return Evaluation(tuple(views), dict(zip(rig.ids, sigmas, strict=True)), shown.renderer, lpips_variant=variant)


def _compare(
    frame: int, name: str, pair: ViewPair, held: FloatArray, masks: tuple[Any, Any], lpips: OnnxLpips | None
) -> ViewQuality:
    """``masks``: moving pixels, changed pixels."""
    truth, (moving, changed) = pair.truth, masks
    shown, still = (picture_quality(image, truth, moving, changed=changed) for image in (pair.image, held))
    return ViewQuality(
        frame=frame,
        camera=name,
        moving_share=float(moving.mean()),
        lpips=math.nan if lpips is None else lpips(pair.image, truth),
        static_lpips=math.nan if lpips is None else lpips(held, truth),
        **shown._asdict(),
        **{f"static_{key}": value for key, value in still._asdict().items()},
    )


def _with_seen(
    quality: ViewQuality, pair: ViewPair, held: FloatArray, changed: BoolArray, seen: BoolArray
) -> ViewQuality:
    """Return these numbers together with those on the pixels that training cameras see."""
    image, truth = pair.image, pair.truth
    return replace(
        quality,
        psnr_seen=psnr(image, truth, seen),
        psnr_changed_seen=psnr(image, truth, changed & seen),
        static_psnr_seen=psnr(held, truth, seen),
        static_psnr_changed_seen=psnr(held, truth, changed & seen),
        seen_share=float(seen.mean()),
    )


def _truth(source: Source, frame: int, split: Literal["train", "test"], order: Sequence[int]) -> FloatArray:
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
