"""Nothing private stands in a stream: no folder, no user, no machine and no password of whoever made it."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsstream.cli.main import run_command
from gsstream.core.names import last_part, without_places
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import encoder_for
from gsstream.input.recordings.base import Wrapped
from gsstream.input.recordings.detect import LAYOUTS
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.origin import public_uri, whole_uri
from gsstream.packet import StreamReader, decode_packet
from gsstream.packet.meta import meta_to_json
from gsstream.recipe.load import resolve_recipe

#: Names such as people give to folders, users and machines; long enough that none is in a word of ours by chance.
secrets = st.text("abcdefghijklmnopqrstuvwxyzXYZ0123456789 .~+=@:%äß", min_size=6, max_size=12).map(
    lambda s: f"qz{s}zq"
)
#: What a stream may say: of each, {} are private parts and the last part is public.
FOLDERS = ["/{}/{}/take", "{}/{}/take", "../{}/take/", "C:\\{}\\{}\\take", "\\\\{}\\{}\\take", "//{}/{}/take"]
SCHEMES = ["disturbed:gain=2:/{}/take", "camera:rtsp://{}:{}@host/take", "panoptic-hd:{}:{}@x", "watch:/{}/take?end={}"]


@pytest.mark.parametrize("shape", FOLDERS)
@pytest.mark.parametrize("layout", ["", *(f"{name}:" for name in LAYOUTS)])
@given(private=st.tuples(secrets, secrets))
def test_of_a_folder_the_last_part_is_left(shape: str, layout: str, private: tuple[str, str]) -> None:
    private = tuple(part.replace(":", "") for part in private)
    assert public_uri(layout + shape.format(*private)) == f"{layout}take"


@pytest.mark.parametrize("layout", ["", *(f"{name}:" for name in LAYOUTS)])
@pytest.mark.parametrize("scheme", ["s3", "gs", "https", "http"])
def test_an_address_is_named_as_its_folder_is(scheme: str, layout: str) -> None:
    """A stream is the same whether its recording lies here or there; the run's folder says which."""
    address = f"{layout}{scheme}://qzbucket/qzfolder/take"
    assert public_uri(address) == public_uri(f"{layout}/home/qz/take") == f"{layout}take"
    assert whole_uri(address) == address


@pytest.mark.parametrize("shape", SCHEMES)
@given(private=st.tuples(secrets, secrets))
def test_of_what_a_plugin_opens_its_name_is_left(shape: str, private: tuple[str, str]) -> None:
    assert public_uri(shape.format(*private)) == f"{shape.partition(':')[0]}:"


@given(user=secrets, word=secrets, host=secrets)
def test_of_an_address_the_name_is_left(user: str, word: str, host: str) -> None:
    for text in (f"https://{user}:{word}@{host}/a/net.onnx?key={word}#{user}", f"/home/{user}/{word}/net.onnx"):
        assert last_part(text) == "net.onnx"
    assert without_places({"a": [{"path": f"/{user}/net.onnx"}, 1.5, None, "plain: word"]}) == {
        "a": [{"path": "net.onnx"}, 1.5, None, "plain: word"]
    }


@pytest.mark.parametrize("uri", ["demo", "synthetic:", "synthetic:frames=3&views=3", "rig:studio"])
def test_what_every_machine_has_is_named_whole(uri: str) -> None:
    assert public_uri(uri) == uri
    assert whole_uri(uri) == uri


def test_the_folder_one_stands_in_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, link = tmp_path / "take", tmp_path / "shown"
    folder.mkdir()
    link.symlink_to(folder)
    monkeypatch.chdir(folder)
    assert {public_uri(uri) for uri in (".", "./", "../take", str(folder))} == {"take"}
    assert public_uri("folder:.") == "folder:take"
    assert {whole_uri(uri) for uri in (".", "../take", str(folder))} == {str(folder)}
    assert public_uri(str(link)) == "shown", "where a link leads is private"


@pytest.mark.parametrize("method", sorted(name for kind, name in load_catalog().entries if kind == "method"))
def test_no_setting_of_ours_is_taken_for_a_path(method: str) -> None:
    values = resolve_recipe(method, load_catalog().recipe_path).recipe.model_dump(mode="json")
    assert without_places(values) == values


TINY = {
    "scale": 0.4,
    "frames": 2,
    "stream.epochs": 1,
    "first_frame.max_iterations": 4,
    "first_frame.points": "sparse",
}


def run(source: str, out: Path) -> bytes:
    settings = [word for key, value in TINY.items() for word in ("--set", f"{key}={value}")]
    command = ["run", "--source", source, "--method", "s2gs-edge", "--out", str(out), "--quiet", "--no-pictures"]
    assert run_command([*command, *settings]) == 0
    return (out / "stream.gss").read_bytes()


def meta_of(stream: Path) -> bytes:
    with StreamReader(stream) as reader:
        return meta_to_json(decode_packet(None, reader.read(reader.frames[0])).meta)


def test_a_run_from_two_folders_has_the_same_bytes_and_finds_its_recording_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in ("first-private", "second-private"):
        shutil.copytree(DEMO_FOLDER, tmp_path / place / "take")
    monkeypatch.chdir(tmp_path / "second-private")
    one = run(str(tmp_path / "first-private" / "take"), tmp_path / "one")
    two = run("take", tmp_path / "two")  # given from where it lies
    assert one == two
    for out in ("one", "two"):
        said = meta_of(tmp_path / out / "stream.gss").decode()
        assert "private" not in said
        assert os.path.basename(tmp_path) not in said
    monkeypatch.chdir("/")
    assert run_command(["evaluate", str(tmp_path / "two"), "--json"]) == 0
    whole = capsys.readouterr().out
    shutil.move(tmp_path / "second-private", tmp_path / "elsewhere")
    assert run_command(["evaluate", str(tmp_path / "two")]) == 2
    assert "no such folder" in capsys.readouterr().err
    moved = str(tmp_path / "elsewhere" / "take")
    assert run_command(["evaluate", str(tmp_path / "two"), "--json", "--source", moved]) == 0
    assert capsys.readouterr().out == whole
    again = ["run", "--source", moved, "--method", "s2gs-edge", "--out", str(tmp_path / "two"), "--resume", "--quiet"]
    settings = [word for key, value in (TINY | {"frames": 3}).items() for word in ("--set", f"{key}={value}")]
    assert run_command([*again, "--no-pictures", *settings]) == 0
    assert (tmp_path / "two" / "recording.txt").read_text() == moved + "\n"


@pytest.mark.parametrize(
    "uri", [f"{DEMO_FOLDER}", f"folder:{DEMO_FOLDER}", "cam:rtsp://qz:qz@qz/a", f"disturbed:gain=2:{DEMO_FOLDER}"]
)
def test_nothing_private_reaches_a_key_packet(uri: str, tmp_path: Path) -> None:
    class Named(Wrapped):
        @property
        def info(self):
            return dataclasses.replace(super().info, uri=uri, name=uri)

    settings = {**TINY, "first_frame.points": "sparse"}
    with_path = {**settings, "confidence": "onnx", "confidence.params.path": "/qzqz/private/net.onnx"}
    source = Named(open_source("demo", 0.4))
    for chosen in (settings, with_path):
        packet = encoder_for("s2gs-edge", source, settings=chosen).encode(source.frame(0)).packet
        meta = decode_packet(None, packet.data).meta
        said = meta_to_json(meta).decode()
        for secret in ("qz", "/", "\\\\", str(DEMO_FOLDER.parent.name) + "/"):
            assert secret not in without_conventions(said), secret
    assert "net.onnx" in said


def without_conventions(text: str) -> str:
    """Conventions are words of ours, in which a slash stands for "divided by"."""
    return text.replace("cut 1/255", "")


def test_a_recording_in_a_folder_of_any_bytes_is_found_again(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"t\xe4ke")
    shutil.copytree(DEMO_FOLDER, folder)
    run(str(folder), tmp_path / "out")
    assert run_command(["evaluate", str(tmp_path / "out")]) == 0
    assert np.frombuffer((tmp_path / "out" / "recording.txt").read_bytes(), np.uint8)[-1] == 10
