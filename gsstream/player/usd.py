"""OpenUSD files: frames as time samples of one prim, by the schema for Gaussian splats (extra ``usd``).

A sample of USD holds all Gaussians, changed or not, so a file is as large as numbered files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import InputError, OutputError
from gsstream.core.install_hints import install_extra
from gsstream.core.memory import require_memory
from gsstream.core.shapes import FloatArray
from gsstream.player.activated import Activated

#: Where the Gaussians are on the stage.
PRIM = "/stream"
#: The colour space of pictures as recorded, by its name in USD.
_COLOURS = "srgb_rec709_scene"
#: Bytes at the peak for every byte of the samples.
_PEAK = 2


def require_usd() -> None:
    """Raise InputError with what to install where USD, or a USD that knows splats, is missing."""
    try:
        from pxr import UsdVol
    except ModuleNotFoundError as error:
        raise InputError(f"writing USD needs usd-core: {install_extra('usd')}") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise InputError(f"the installed usd-core knows no splats, expected 26.3 or newer: {install_extra('usd')}")


def write_usd(
    path: Path,
    frames: Sequence[int],
    scene_at: Callable[[int], Activated],
    *,
    fps: float,
    to_recording: FloatArray,
    said: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> None:
    """Write frames, z up, time codes counting frames of the stream.

    What never changes has no samples; what changes has one in every frame, because USD interpolates between samples.
    The size is said before work begins. ``to_recording`` [4, 4], from the file's coordinates to those of the
    recording, is stated in the layer's own data, as USD writes matrices (for rows).

    Raises InputError for frames without Gaussians, for what would take more memory than allowed and for a
    degree that changes, OutputError when the file cannot be written.
    """
    from pxr import Gf, Tf, Usd, UsdGeom, UsdVol

    changing, size = _changes(frames, scene_at)
    said(f"a sample of USD holds every Gaussian: {len(frames)} frames take {size / 1e6:.1f} MB")
    require_memory(_PEAK * size, f"writing {len(frames)} frames of USD")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().customLayerData = {"toRecording": Gf.Matrix4d(to_recording.T.tolist())}
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[-1])
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    prim = splat.GetPrim()
    stage.SetDefaultPrim(prim)
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(_COLOURS)
    for done, frame in enumerate(frames):
        splats = scene_at(frame)
        if done == 0:
            splat.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
        for name, value in _values(splats).items():
            attribute = prim.GetAttribute(name)
            if done == 0:  # the default value, for readers that ask for no time
                attribute.Set(value)
            if name in changing:
                attribute.Set(value, frame)
        progress(done + 1, len(frames))
    try:
        whole = stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException as error:
        raise OutputError(f"cannot write {path}: {error}") from error
    if not whole:
        raise OutputError(f"cannot write {path}: USD did not say why")


def _values(splats: Activated) -> dict[str, Any]:
    """Return attribute of the schema -> its value in USD's types."""
    from pxr import Vt

    extent = np.stack([splats.means.min(0), splats.means.max(0)])
    reach = 3 * splats.scales.max()  # a splat is drawn up to three standard deviations from its centre
    return {
        "positions": Vt.Vec3fArray.FromNumpy(splats.means),
        "orientations": Vt.QuatfArray.FromNumpy(splats.quats),
        "scales": Vt.Vec3fArray.FromNumpy(splats.scales),
        "opacities": Vt.FloatArray.FromNumpy(splats.opacities),
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(splats.harmonics.reshape(-1, 3)),
        "extent": Vt.Vec3fArray.FromNumpy(extent + np.array([[-reach], [reach]], np.float32)),
    }


def _arrays(splats: Activated) -> Iterator[tuple[tuple[str, ...], FloatArray]]:
    """Attributes of the schema that follow from one array, and that array."""
    yield ("positions", "extent"), splats.means
    yield ("orientations",), splats.quats
    yield ("scales", "extent"), splats.scales
    yield ("opacities",), splats.opacities
    yield ("radiance:sphericalHarmonicsCoefficients",), splats.harmonics


def _changes(frames: Sequence[int], scene_at: Callable[[int], Activated]) -> tuple[set[str], int]:
    """Return the attributes that change from a frame to another, and the bytes of all that USD stores once."""
    changing: set[str] = set()
    size, before, degree = 0, None, 0
    for frame in frames:
        splats = scene_at(frame)
        if len(splats) == 0:
            raise InputError(f"USD readers refuse an empty list of splats, and frame {frame} has no Gaussians")
        if before is None:
            degree = splats.degree
        if splats.degree != degree:
            raise InputError(
                f"USD holds one degree of harmonics: expected {degree} in frame {frame}, got {splats.degree}"
            )
        found = list(_arrays(splats))
        for index, (names, array) in enumerate(found):
            if before is None or not np.array_equal(before[index], array):
                size += array.nbytes
                changing.update(names if before is not None else ())
        before = [array for _, array in found]
    return changing, size
