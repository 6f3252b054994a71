"""Published protocols: conditions on a recording for numbers that are comparable to printed ones, and those numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gsstream.core.errors import InputError, UnknownName
from gsstream.evaluation.evaluate import Evaluation
from gsstream.evaluation.records import mean
from gsstream.input.recordings.base import SourceInfo


@dataclass(frozen=True, slots=True)
class EvaluationProtocol:
    """How a paper measures: size of the pictures, cameras, and number of frames from the first on."""

    width: int  # pixels
    height: int
    test: tuple[str, ...]  # the test cameras, by id
    train: int | None  # number of training cameras; None: all others, which differ from scene to scene
    frames: int
    source: str  # the paper
    how: str  # what a recording of another size or other cameras needs


PROTOCOLS: Mapping[str, EvaluationProtocol] = MappingProxyType(
    {
        "panoptic-sports": EvaluationProtocol(
            640,
            360,
            ("cam00", "cam10", "cam15", "cam30"),
            27,
            150,
            "Dynamic 3D Gaussians (Luiten et al. 2024)",
            "run with --scale 1 and without data.train_views, data.train_cameras or data.test_cameras",
        ),
        "n3dv": EvaluationProtocol(
            1352,
            1014,
            ("cam00",),
            None,
            300,
            "Neural 3D Video (Li et al. 2022), as 3DGStream and S2GS measure it",
            "run with --recipe recording:n3dv",
        ),
        "meetroom": EvaluationProtocol(
            1280,
            720,
            ("cam_0",),
            12,
            300,
            "StreamRF (Li et al. 2022), as 3DGStream and S2GS measure it",
            "run with --recipe recording:meetroom",
        ),
    }
)


def find_protocol(name: str) -> EvaluationProtocol:
    """Return the protocol of this name. Raises UnknownName."""
    if name not in PROTOCOLS:
        raise UnknownName("protocol", name, list(PROTOCOLS))
    return PROTOCOLS[name]


def check_protocol(name: str, info: SourceInfo, leak: str, frames: Sequence[int]) -> None:
    """Refuse what is measured otherwise than the protocol says.

    Arguments:
        name: name of the protocol.
        info: the recording as it was used, after scale and split.
        leak: ``data.leak`` of the run: what its test cameras gave to it.
        frames: to be evaluated, ascending: the first one and those after it, at most as many as the protocol has.

    Raises InputError, and UnknownName for another protocol.
    """
    wanted, rig = find_protocol(name), info.test
    test = wanted.test if _numbered(rig.ids) == _numbered(wanted.test) else rig.ids
    found = {
        "pictures": (f"{wanted.width} x {wanted.height}", f"{rig.width} x {rig.height}"),
        "test cameras": (", ".join(sorted(wanted.test)), ", ".join(sorted(test)) or "none"),
        "training cameras": (wanted.train or len(info.train), len(info.train)),
        "data.leak": ("none", leak),
    }
    for what, (expected, got) in found.items():
        if expected != got:
            raise InputError(f"--protocol {name}: {what}: expected {expected}, got {got}; {wanted.how}")
    if list(frames) != list(range(len(frames))) or len(frames) > wanted.frames:
        raise InputError(
            f"--protocol {name}: frames: expected 0 to at most {wanted.frames - 1}, got {frames[0]} to {frames[-1]}; "
            f"say --frames 0:{wanted.frames}"
        )


def _numbered(cameras: Sequence[str]) -> list[str]:
    """The cameras in order, without leading zeros: cam0 of one copy of a recording is cam00 of another."""
    return sorted(re.sub(r"\d+", lambda number: str(int(number.group())), name) for name in cameras)


def protocol_numbers(name: str, evaluation: Evaluation) -> dict[str, Any]:
    """Return the protocol's numbers: means over test cameras and frames, the first included."""
    wanted, frames = find_protocol(name), {view.frame for view in evaluation.views}
    names = ("psnr", "ssim") if evaluation.lpips_variant is None else ("psnr", "ssim", "lpips")
    means = {key: mean(getattr(view, key) for view in evaluation.views) for key in names}
    return {"name": name, "frames": len(frames), "of_frames": wanted.frames, "source": wanted.source, **means}


def protocol_line(numbers: Mapping[str, Any]) -> str:
    """Return the same in a sentence."""
    lpips = f", LPIPS {numbers['lpips']:.3f}" if "lpips" in numbers else ""
    return (
        f"protocol {numbers['name']} of {numbers['source']}: PSNR {numbers['psnr']:.2f} dB, SSIM {numbers['ssim']:.3f}"
        f"{lpips}; means over test cameras and {numbers['frames']} frames of its {numbers['of_frames']}, the first "
        "included, no colour of a test camera corrected"
    )
