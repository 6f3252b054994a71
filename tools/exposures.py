"""Cameras that expose differently: what helps, with gains that are known.

Usage: python -m tools.exposures --source DIR --frames 15 --out OUT [-- --method s2gs-edge --recipe recording:live ...]

Copies a recording whose cameras agree, with gains of up to 15 % for each training camera and channel. It is encoded as
it was, with gains, with gains and a colour map for each camera (``first_frame.exposure``), and with gains divided by
those that ``exposure: match`` of a rig file finds in the first instant. The test cameras keep their colours. What
follows ``--`` goes to ``gsstream run``. Prints a line of JSON for each.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsstream.core.errors import InputError
from gsstream.evaluation.records import mean
from gsstream.input.recordings.calibration import CALIBRATION_FILE, frame_path, read_calibration
from gsstream.input.recordings.pointfiles import POINTS_FILE
from tools.drill import GSSTREAM

USUAL = ("--method", "s2gs-edge", "--recipe", "recording:live")
MAPS = ("--set", "first_frame.exposure=true")


def gains_of(cameras: int, most: float, seed: int) -> Any:
    """[C, 3] gains up to ``most`` above and below one, whose logarithms have the median and the mean zero."""
    draw = np.random.default_rng(seed)
    half = draw.uniform(-np.log1p(most), np.log1p(most), (cameras // 2, 3))
    middle = np.zeros((cameras % 2, 3))
    return np.exp(draw.permutation(np.concatenate([half, -half, middle])))


def changed(source: Path, out: Path, gains: dict[str, Any], frames: int) -> Path:
    """Copy a recording with the colours of cameras multiplied; ``gains`` [3] by camera, blue first."""
    filed = read_calibration(source)
    out.mkdir(parents=True)
    data = json.loads((source / CALIBRATION_FILE).read_text(encoding="utf-8"))
    (out / CALIBRATION_FILE).write_text(json.dumps({**data, "frames": frames}), encoding="utf-8")
    if (source / POINTS_FILE).exists():
        shutil.copyfile(source / POINTS_FILE, out / POINTS_FILE)
    for name, pattern in filed.patterns.items():
        for frame in range(frames):
            path = frame_path(pattern, frame)
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            pixels = cv2.imread(str(source / path), cv2.IMREAD_COLOR)
            if pixels is None:
                raise InputError(f"{source / path}: the picture cannot be decoded")
            shown = np.clip(np.round(pixels * gains.get(name, np.ones(3))), 0, 255).astype(np.uint8)
            cv2.imwrite(str(out / path), shown, [cv2.IMWRITE_JPEG_QUALITY, 97])
    return out


def found_in(folder: Path) -> dict[str, Any]:
    """Return the gains that a check finds in the first instant of the training cameras; NaN where it finds none."""
    from gsstream_capture.exposure import gains
    from gsstream_capture.pictures import CameraPlan

    filed = read_calibration(folder)
    rig = filed.train
    size = (rig.width, rig.height)
    plans = [CameraPlan(name, rig.Ks[i], rig.viewmats[i], size, "train") for i, name in enumerate(rig.ids)]
    pictures = [cv2.imread(str(folder / frame_path(filed.patterns[name], 0))) for name in rig.ids]
    return dict(zip(rig.ids, gains(pictures, plans), strict=True))


def encoded(folder: Path, out: Path, options: Sequence[str]) -> dict[str, Any]:
    """Encode, and return decibels and bytes against the test cameras."""
    command = [*GSSTREAM, "run", "--source", str(folder), "--out", str(out), "--no-pictures", "--quiet", *options]
    subprocess.run(command, check=True)
    command = [*GSSTREAM, "evaluate", str(out), "--json"]
    views = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["views"]
    first, later = ([view["psnr"] for view in views if (view["frame"] > 0) == after] for after in (False, True))
    return {"psnr_first_dB": round(mean(first), 2), "psnr_later_dB": round(mean(later), 2)}


def compare(source: Path, out: Path, given: argparse.Namespace, options: Sequence[str]) -> None:
    """Print a row for each way. Raises InputError where ``out`` is not new."""
    frames = given.frames
    if out.exists():
        raise InputError(f"{out} exists; expected a new folder, choose another --out")
    names = read_calibration(source).train.ids
    applied = dict(zip(names, gains_of(len(names), given.most, given.seed), strict=True))
    plain = changed(source, out / "plain", {}, frames)
    gained = changed(source, out / "gained", applied, frames)
    found = found_in(gained)
    known = [name for name in names if not np.isnan(found[name]).any()]
    off = np.array([found[name] / applied[name] for name in known])
    off = np.abs(off / np.median(off, axis=0) - 1)
    undone = {name: applied[name] / (found[name] if name in known else 1) for name in names}
    matched = changed(source, out / "matched", undone, frames)
    facts = {"cameras": len(names), "gains_known": len(known), "gains_off_percent": round(100 * float(off.max()), 1)}
    ways = {
        "as it was": (plain, (), {}),
        "gains": (gained, (), {}),
        "gains, maps": (gained, MAPS, {}),
        "gains, matched": (matched, (), facts),
    }
    for number, (name, (folder, more, known_facts)) in enumerate(ways.items()):
        row = {"way": name, **encoded(folder, out / f"run{number}", [*options, *more]), **known_facts}
        print(json.dumps(row), flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    place = given.index("--") if "--" in given else len(given)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True, help="a folder with cameras.json and JPEG pictures")
    parser.add_argument("--frames", type=int, default=15)
    parser.add_argument("--most", type=float, default=0.15, help="largest gain, as a share")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    wanted = parser.parse_args(given[:place])
    compare(wanted.source, wanted.out, wanted, given[place + 1 :] or USUAL)
    return 0


if __name__ == "__main__":
    sys.exit(main())
