"""Camera ids become folder names: nothing that is read may lead out of the folder that is written to."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_player import ARC, look_at

from gsstream.core.errors import OutputError, PacketError, ShapeError, SourceError
from gsstream.core.names import MAX_NAME_BYTES, check_camera_ids, child
from gsstream.input.recordings.open import open_source
from gsstream.packet import StreamMeta
from gsstream.packet.meta import meta_from_json, meta_to_json

HOSTILE = [
    "../x", "..", ".", "", "/abs", "a/b", "a\\b", "C:x", "nul", "CON.png", "COM1", "a\0b", "a\nb", "a\x1b]0;t\x07",
    "\ud800", "a\u2028b", "x" * (MAX_NAME_BYTES + 1), "\N{SNOWMAN}" * 41, "dot.", "space ",
]  # fmt: skip
HARMLESS = ["cam00", "0", "left eye", "kamera-ä", "GoPro_07.mp4", "consul", "-dash", ".hidden", "(1)", "x" * 120]


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_hostile_ids_are_refused_and_never_joined(name: str, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="rename the camera"):
        check_camera_ids(["cam00", name])
    with pytest.raises(OutputError):
        child(tmp_path, name)


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_ids_pass_and_lie_directly_in_the_folder(name: str, tmp_path: Path) -> None:
    check_camera_ids([name])
    child(tmp_path, name).mkdir()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def small_meta(ids: tuple[str, str]):
    rig = replace(look_at(ARC[:2]), ids=ids)
    return StreamMeta("dense", "test", {}, rig.select([0]), rig.select([1]), 25.0)


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_a_stream_with_hostile_ids_is_neither_read_nor_written(name: str) -> None:
    honest = json.loads(meta_to_json(small_meta(("cam0", "cam1"))))
    honest["test"]["ids"] = [name]
    with pytest.raises(PacketError, match="camera id"):
        meta_from_json(json.dumps(honest).encode())
    with pytest.raises(ShapeError, match="camera id"):
        meta_to_json(small_meta(("cam0", name)))


@pytest.mark.parametrize("name", [name for name in HOSTILE if name], ids=ascii)
def test_a_calibration_with_hostile_ids_is_refused(name: str, tmp_path: Path) -> None:
    camera = {
        "id": name,
        "width": 8,
        "height": 8,
        "K": np.diag([8.0, 8.0, 1.0]).tolist(),
        "w2c": np.eye(4).tolist(),
        "frames": "a/%06d.png",
    }
    data = {"schema": "opencv-multiview-1", "frames": 1, "cameras": [camera]}
    (tmp_path / "cameras.json").write_text(json.dumps(data))
    with pytest.raises(SourceError, match="camera id"):
        open_source(str(tmp_path))


def test_pictures_of_many_cameras_stay_beside_each_other(tmp_path: Path) -> None:
    """The command joins ids to --out; a reader that let one through must not be the only guard."""
    from gsstream.cli.streams import _one_of_many

    assert _one_of_many(tmp_path, "cam0") == tmp_path / "cam0"
    assert _one_of_many(tmp_path / "v.mp4", "cam0") == tmp_path / "v-cam0.mp4"
    for out in (tmp_path, tmp_path / "v.gif"):
        for name in ("../x", "/abs", "a/b"):
            with pytest.raises(OutputError):
                _one_of_many(out, name)


def test_prepare_writes_nothing_for_a_hostile_rig(tmp_path: Path) -> None:
    from gsstream.input.prepare.prepare import PrepareOptions, prepare

    raw = tmp_path / "raw"
    raw.mkdir()
    cameras = [
        {"id": name, "width": 8, "height": 8, "K": [], "w2c": [], "frames": "a/%06d.png"}
        for name in ("../pwned", "pwned_abs")
    ]
    (raw / "cameras.json").write_text(json.dumps({"schema": "opencv-multiview-1", "frames": 1, "cameras": cameras}))
    with pytest.raises(SourceError, match="camera id"):
        prepare(raw, tmp_path / "out", PrepareOptions(), lambda _: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["raw"]
