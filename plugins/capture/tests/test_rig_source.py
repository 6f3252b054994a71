"""``rig:`` captures and is followed; what it delivers is what the folder holds."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from gsstream_capture.source import open_rig
from live_rig import calibration, encoded, grey, number_of, painted, rig_file

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.encode import open_recording

SIZE = (160, 120)


@pytest.fixture
def films(tmp_path):
    calibration(tmp_path, ["a", "b"], SIZE)
    for k, name in enumerate("ab"):
        encoded(tmp_path / name, (painted(grey(i, SIZE, k), i) for i in range(45)), 15, suffix="mp4")
    return rig_file(tmp_path, {"a": "a.mp4", "b": "b.mp4"}, 15)


def test_a_run_follows_what_is_captured(films, tmp_path) -> None:
    seen = []
    with open_recording(f"rig:{films}?folder={tmp_path / 'kept'}&behind=block") as source:
        assert source.info.num_frames is None
        assert source.info.uri == str(tmp_path / "kept"), "the stream names the folder"
        with suppress(EndOfRecording):
            while (frame := source.frame(len(seen))).arrival is not None:
                seen.append([number_of(np.uint8(255 * image)) for image in frame.images])
    first = seen[0][0]
    assert seen == [[k, k] for k in range(first, first + len(seen))]
    assert len(seen) >= 40
    with open_recording(f"watch:{tmp_path / 'kept'}?ready=rename") as again:
        assert np.array_equal(again.frame(7).images, frame_of(again, 7))


def frame_of(source, index):
    return np.stack([source.image(index, name) for name in source.info.train.ids])


def test_closing_ends_the_capture(films, tmp_path) -> None:
    source = open_rig(f"rig:{films}")
    source.frame(0)
    (folder,) = tmp_path.glob("rig-2*")
    source.close()
    assert (folder / "END").exists()
    files = len(list(folder.glob("a/*.jpg")))
    time.sleep(0.5)
    assert len(list(folder.glob("a/*.jpg"))) == files


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("rig:", "got no file"),
        ("rig:RIG?behid=drop", "unknown option 'behid'; did you mean 'behind'"),
        ("rig:RIG?folder=FULL", "is not empty"),
        ("rig:absent.yaml", "cannot be read"),
        ("rig:BARE", "calibrate first: gsstream calibrate board"),
    ],
)
def test_what_cannot_be_captured_is_said(films, tmp_path, uri, message) -> None:
    bare = tmp_path / "bare.yaml"
    bare.write_text('cameras: [{id: a, url: "a.mp4"}]')
    uri = uri.replace("RIG", str(films)).replace("FULL", str(tmp_path)).replace("BARE", str(bare))
    with pytest.raises(SourceError, match=message):
        open_rig(uri)
    assert Path(films).exists()
