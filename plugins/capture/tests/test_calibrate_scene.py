"""Calibration by what the cameras see: what is written is what was found."""

from __future__ import annotations

import numpy as np
import pytest
from gsstream_capture.board.solve import camera_row, write_cameras
from gsstream_capture.scene import coefficients

from gsstream.cli.main import run_command
from gsstream.input.recordings.calibration import read_calibration
from gsstream.input.recordings.lens import Lens


@pytest.mark.parametrize(
    "lens", [Lens("radial", (-0.1,)), Lens("radial", (-0.1, 0.02), (1e-3, -2e-3)), Lens("radial", (-0.1, 0.02, 0.3))]
)
def test_lenses_are_read_back_as_they_were(tmp_path, lens) -> None:
    K = np.array([[300.0, 0, 161], [0, 310, 119], [0, 0, 1]])
    row = camera_row("a", (320, 240), lens=coefficients(K, lens), w2c=np.eye(4))
    write_cameras(tmp_path / "cameras.json", [row], fps=12.5, units="none")
    found = read_calibration(tmp_path, growing=True)
    assert (found.fps, found.sizes) == (12.5, {"a": (320, 240)})
    assert np.array_equal(found.train.Ks[0], K)
    x, y = np.array([0.3, -0.2]), np.array([0.1, 0.25])
    assert np.allclose(found.lenses["a"].distort(x, y), lens.distort(x, y), atol=1e-15)


def test_what_is_no_take_is_refused(tmp_path, capsys) -> None:
    assert run_command(["calibrate", "scene", str(tmp_path), "--out", str(tmp_path / "rig.json")]) == 2
    assert "expected a file of the name cameras.json" in capsys.readouterr().err
    assert run_command(["calibrate", "scene", str(tmp_path), "--out", str(tmp_path / "cameras.json")]) == 2
    assert "expected at least two cameras" in capsys.readouterr().err
