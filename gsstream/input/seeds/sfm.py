"""Structure from motion in a process of its own: what goes in, and how it runs. Needs ``gsstream[sfm]``."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.install_hints import install_extra
from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import FloatArray


def write_images(folder: Path, images: Iterable[FloatArray]) -> None:
    """Write C images [H, W, 3] in [0, 1] where the pycolmap process looks for them, numbered."""
    (folder / "images").mkdir()
    for i, image in enumerate(images):
        pixels = np.round(image * 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i:04d}.png", compress_level=1)


def write_rig(folder: Path, cameras: Cameras) -> None:
    """Write the known poses and pinhole intrinsics for the pycolmap process."""
    size = np.array([cameras.width, cameras.height])
    np.savez(folder / "rig.npz", viewmats=cameras.viewmats, Ks=cameras.Ks, size=size)


def run_pycolmap(task: str, folder: Path, timeout: float, tell: Tell = silent) -> None:
    """Run one task of ``gsstream.input.seeds._pycolmap`` on a folder, in a process of its own.

    Raises InputError when pycolmap is not installed, and when the process fails or takes more than ``timeout`` seconds.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            f"structure from motion needs pycolmap, which is not installed: {install_extra('sfm')}, "
            "or give the recording a points_frame0.npz"
        )
    command = [sys.executable, "-m", "gsstream.input.seeds._pycolmap", task, str(folder)]
    # COLMAP's logger leaves a file for every process where temporary files go: that folder is removed with the rest.
    with (
        (folder / "log.txt").open("w") as log,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, env={**os.environ, "TMPDIR": str(folder)}
        ) as process,
    ):
        late = threading.Timer(timeout, process.kill)
        late.start()
        try:
            for line in process.stdout or ():
                if (sign := re.fullmatch(r"sign (\d+) (\d+) (.*)\n", line)) is not None:
                    tell(sign[3], int(sign[1]), int(sign[2]))
            code = process.wait()
        except BaseException:
            process.kill()
            raise
        finally:
            in_time = late.is_alive()
            late.cancel()
    if not in_time:
        raise InputError(
            f"structure from motion did not finish within {timeout:g} s; shrink the images (scale) or give points"
        )
    if code != 0:
        said = (folder / "log.txt").read_text(errors="replace").strip().splitlines()[-3:]
        how = f"was ended by signal {-code}" if code < 0 else f"exited with {code}"
        raise InputError(f"structure from motion: the pycolmap process {how}: {' | '.join(said)}")
