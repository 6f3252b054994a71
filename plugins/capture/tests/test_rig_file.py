"""The rig file: what is wrong in it is said by its place, and no password is."""

from __future__ import annotations

import re

import pytest
from gsstream_capture.rig import opening_of, read_rig, shown, without_secrets
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.errors import SourceError

ONE = 'cameras: [{id: a, url: "rtsp://h/s"}]\n'


def read(tmp_path, text, environment=None):
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return read_rig(path, environment or {})


def test_what_a_rig_file_says(tmp_path) -> None:
    rig = read(
        tmp_path,
        "fps: 12.5\ncalibration: c/cameras.json\ncameras:\n"
        '- {id: left, url: "rtsp://${U}:${P}@10.0.0.1/s", rotate: 90, delay_ms: 30, transport: udp}\n'
        "- {id: file, url: clip.mp4}\n",
        {"U": "me", "P": "se:cret"},
    )
    assert rig.fps == 12.5
    assert rig.calibration == tmp_path / "c" / "cameras.json"
    assert rig.cameras[0].url == "rtsp://me:se:cret@10.0.0.1/s"
    assert "cret" not in repr(rig)
    assert opening_of(rig.cameras[0], tmp_path, "").options["rtsp_transport"] == "udp"
    assert opening_of(rig.cameras[1], tmp_path, "").target == str(tmp_path / "clip.mp4")


@pytest.mark.parametrize(
    ("url", "options"),
    [
        ("v4l2:///dev/video0?size=1280x720&fourcc=MJPG", {"video_size": "1280x720", "input_format": "mjpeg"}),
        ("v4l2:///dev/video2?fps=30&fourcc=yuyv", {"framerate": "30", "input_format": "yuyv422"}),
        ("v4l2:///dev/video0", {}),
    ],
)
def test_options_of_a_webcam(tmp_path, url, options) -> None:
    rig = read(tmp_path, f'cameras: [{{id: a, url: "{url}"}}]')
    opening = opening_of(rig.cameras[0], tmp_path, "")
    assert (opening.target, opening.format) == (url[7:].partition("?")[0], "v4l2")
    assert opening.options == {"timestamps": "abs"} | options


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('cameras: [{id: a, url: "ftp://u:hidden@h/s"}]', r"cameras\[0\].url: expected rtsp://, .* got 'ftp'://"),
        ('cameras: [{id: a, url: "rtsp://${NOT}@h/s"}]', r"cameras\[0\].url: the environment has no NOT; set it"),
        ('cameras: [{id: a, url: "v4l2:///dev/video0?sice=1x1"}]', "unknown option 'sice'; did you mean 'size'"),
        ('cameras: [{id: a, url: "v4l2:///dev/video0?size=big"}]', "expected WIDTHxHEIGHT"),
        ('cameras: [{id: a, url: "rtsp://u:hidden@h/s", rotat: 90}]', r"cameras\[0\].rotat: unknown key; did you mean"),
        (
            'cameras: [{id: a, url: "rtsp://u:hidden@h/s", rotate: 45}]',
            r"cameras\[0\].rotate: input should be .* got 45",
        ),
        ('cameras: [{id: a, url: ["rtsp://u:hidden@h/s"]}]', r"cameras\[0\].url: input should be a valid string"),
        ("cameras: [{id: a}]", r"cameras\[0\].url: field required"),
        ("cameras: []", "cameras: .*at least 1"),
        ("fsp: 10\n" + ONE, "fsp: unknown key; did you mean 'fps'"),
        ("fps: 0\n" + ONE, "fps: .*greater than 0, got 0"),
        ('cameras: [{id: a, url: x}, {id: a, url: "rtsp://u:hidden@h"}]', "more than once: a"),
        ('cameras: [{id: "a/b", url: x}]', "a/b"),
        ("[1, 2]", "expected the keys"),
        ("cameras: [{id: a, url: rtsp://u:hidden@h: s}", "line 1: not valid YAML; quote addresses"),
        ("a: 1\na: 2\n", "not valid YAML"),
    ],
)
def test_what_is_wrong_is_said_without_passwords(tmp_path, text, message) -> None:
    with pytest.raises(SourceError, match=message) as caught:
        read(tmp_path, text)
    told = str(caught.value)
    assert "hidden" not in told
    assert caught.value.__cause__ is None or "hidden" not in str(caught.value.__cause__)
    assert str(tmp_path) in told


def test_a_rig_file_that_is_not_there(tmp_path) -> None:
    with pytest.raises(SourceError, match="cannot be read: No such file"):
        read_rig(tmp_path / "rig.yaml")


WORD = st.text("abcXYZ0189._~-%!", min_size=4, max_size=12)


@given(WORD, WORD, WORD, st.sampled_from(["rtsp", "http"]))
def test_no_text_tells_a_password(user, password, value, scheme) -> None:
    url = f"{scheme}://{user}:{password}@host.example:8554/live/1?pw={value}"
    told = without_secrets(f"[Errno 111] Connection refused: '{url}'; user {user}, {password}; {value}", [url])
    place = f"{scheme}://host.example:8554/live/1?..."
    assert shown(url) == place
    rest = told.replace(place, "").replace("[Errno 111] Connection refused", "")
    assert not any(re.search(re.escape(secret), rest) for secret in (user, password, value))
