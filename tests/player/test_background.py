"""What is behind a scene is that of its frame: a lamp that is switched changes it, whoever draws, exports or reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsstream.packet import FORMAT_VERSION
from gsstream.player.export import export
from gsstream.player.play import play
from gsstream.player.playback import Playback
from gsstream.player.render import render, to_bytes

STREAM = Path(__file__).parents[1] / "packet" / "samples" / FORMAT_VERSION / "light.gss"
CAMERA = "held-out"


@pytest.fixture(scope="module")
def known() -> dict[int, tuple[tuple[float, float, float], np.ndarray]]:
    """Frame -> its background and its picture before that, by the state of the player alone."""
    found = {}
    with Playback(STREAM) as playback:
        for frame in playback.frames:
            state = playback.player_state(frame)
            behind = state.meta.background
            picture = render(state.gaussians, state.meta.camera(CAMERA), 0, background=behind)
            found[frame] = behind, to_bytes(picture)
    assert len({behind for behind, _ in found.values()}) == 4
    return found


def test_pictures_are_drawn_before_it(tmp_path: Path, known) -> None:
    play(STREAM, tmp_path / "out", camera=CAMERA)
    for frame, (_, wanted) in known.items():
        with Image.open(tmp_path / "out" / f"{frame:06d}.png") as picture:
            assert np.array_equal(np.asarray(picture), wanted), frame


def test_a_picture_between_two_frames_is_drawn_before_that_of_the_first(tmp_path: Path, known) -> None:
    with Playback(STREAM) as playback:
        fps = playback.meta.fps
    play(STREAM, tmp_path / "out", camera=CAMERA, fps=2 * fps)
    pictures = sorted((tmp_path / "out").glob("*.png"))
    assert len(pictures) == 2 * len(known) - 1
    for frame, (_, wanted) in known.items():
        with Image.open(pictures[2 * frame]) as picture:
            assert np.array_equal(np.asarray(picture), wanted), frame


def test_a_sequence_says_it_for_every_frame_whose_is_another(tmp_path: Path, known) -> None:
    export(STREAM, tmp_path / "out", kind="sequence")
    said = json.loads((tmp_path / "out" / "sequence.json").read_text())
    for entry in said["frames"]:
        assert tuple(entry.get("background", said["background"])) == known[entry["frame"]][0]
    assert sum("background" in entry for entry in said["frames"]) == 4
