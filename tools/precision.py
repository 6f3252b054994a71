"""What half floats would cost a decoded scene: parameters, or the projected records of a renderer, stored in 16 bits.

Usage: python -m tools.precision STREAM

Every attribute of the last frame is rounded to float16 or bfloat16, alone and all together, and the cameras rendered
again; records are rounded in the reference renderer, between projection and compositing, on a few strips of rows.
Printed: the largest difference of a pixel, and the PSNR of the changed picture against the unchanged one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.parts.render.reference import composite, project
from gsstream.player.playback import Playback
from gsstream.player.render import find_renderer, render

KINDS = {"float16": torch.float16, "bfloat16": torch.bfloat16}
#: Strips of rows of a picture in which records are looked at, and the rows of each.
STRIPS, ROWS = 4, 4
Background = tuple[float, float, float]


def rounded(values: torch.Tensor, kind: str) -> torch.Tensor:
    """The values that ``kind`` can hold, as float32."""
    return values.to(KINDS[kind]).float()


def parameter_errors(
    scene: Gaussians[FloatArray], cameras: Cameras, background: Background
) -> Iterator[tuple[str, str, float, float]]:
    """(attribute or "all", kind, worst pixel, PSNR against float32) over all cameras."""
    renderer = find_renderer()
    views = range(len(cameras))
    exact = [render(scene, cameras, view, background, renderer) for view in views]
    for kind in KINDS:
        for name in (*ATTRIBUTES, "all"):
            names = ATTRIBUTES if name == "all" else (name,)
            changed = {n: rounded(torch.from_numpy(getattr(scene, n)), kind).numpy() for n in names}
            other = [render(replace(scene, **changed), cameras, view, background, renderer) for view in views]
            yield (name, kind, *_compare(np.stack(exact), np.stack(other)))


def record_errors(
    scene: Gaussians[FloatArray], cameras: Cameras, view: int, background: Background
) -> Iterator[tuple[str, str, float, float]]:
    """The same for what a renderer keeps per camera and Gaussian: 2-D mean, inverse covariance, colour, opacity."""
    with torch.no_grad():
        means, conics, colors, depths, opacities = project(scene.map(torch.from_numpy), cameras, view)
        order = torch.argsort(depths, stable=True)
        order = order[depths[order] > cameras.near]
        parts = {"2-D mean": means, "conic": conics, "colour": colors, "opacity": opacities}
        parts = {name: value[order] for name, value in parts.items()}
        places = parts["2-D mean"][:, 1]
        reach = torch.linalg.inv(parts["conic"])[:, 1, 1].sqrt()
        exact = _strips(parts, places, reach, cameras, background)
        for kind in KINDS:
            for name in (*parts, "all"):
                changed = {n: rounded(v, kind) if name in (n, "all") else v for n, v in parts.items()}
                yield (f"record: {name}", kind, *_compare(exact, _strips(changed, places, reach, cameras, background)))


def _strips(
    parts: dict[str, torch.Tensor], places: torch.Tensor, reach: torch.Tensor, cameras: Cameras, background: Background
) -> FloatArray:
    starts = np.linspace(0, max(0, cameras.height - ROWS), STRIPS).astype(int).tolist()
    ends = [min(cameras.height, start + ROWS) for start in starts]
    color = torch.tensor(background)
    pictures = []
    # An alpha above the cut of 1/255 is within 3.4 standard deviations; the exact ones, so that all see the same rows.
    for start, end in zip(starts, ends, strict=True):
        near = (places - (start + end) / 2).abs() <= ROWS / 2 + 4 * reach
        means, conics, colors, opacities = (value[near] for value in parts.values())
        pictures.append(composite(means, conics, colors, opacities, start, end, cameras.width, color)[0])
    return np.asarray(torch.cat(pictures).numpy())


def _compare(exact: FloatArray, other: FloatArray) -> tuple[float, float]:
    difference = np.abs(np.clip(exact, 0, 1).astype(np.float64) - np.clip(other, 0, 1))
    if not np.isfinite(difference).all():
        return float("inf"), float("-inf")
    return float(difference.max()), float(-10 * np.log10(max(np.square(difference).mean(), 1e-20)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", type=Path)
    parser.add_argument("--no-records", action="store_true", help="skip the slow part")
    given = parser.parse_args(arguments)
    with Playback(given.stream) as playback:
        scene, background = playback.state_at(playback.frames[-1]), playback.meta.background
        cameras = playback.cameras("test") if len(playback.cameras("test")) else playback.cameras("train")
    print(f"| {len(scene)} Gaussians, {len(cameras)} cameras | kind | worst pixel | PSNR against float32, dB |")
    print("|---|---|--:|--:|")
    rows = [parameter_errors(scene, cameras, background)]
    if not given.no_records:
        rows.append(record_errors(scene, cameras, 0, background))
    for table in rows:
        for name, kind, worst, psnr in table:
            print(f"| {name} | {kind} | {worst:.2g} | {psnr:.1f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
