"""``gsstream export --format page``: what it writes, what it leaves alone, what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from moving_scenes import moving_packets
from pictures import drawn, psnr
from PIL import Image

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, OutputError, PacketError
from gsstream.packet import StreamReader, StreamWriter
from gsstream.packet.base import file_header
from gsstream.player.playback import Playback
from gsstream.serve.package import package

WEB = Path(__file__).parents[2] / "gsstream" / "web"
EXAMPLES = WEB.parents[1] / "docs" / "examples"


def write(path: Path, **settings: int) -> Path:
    with StreamWriter.open(path) as writer:
        for packet in moving_packets(**{"seed": 4, "frames": 6, "number": 30, "key_at": 3, **settings}):
            writer.append(packet)
    return path


def segments(folder: Path) -> list[str]:
    manifest = json.loads((folder / "stream.json").read_text())
    return [s["file"] for entry in (manifest, *manifest["renditions"]) for s in entry["segments"]]


def test_every_module_is_one_that_the_page_may_load():
    """What is for scripts alone lies in ``docs/examples``."""
    found, waiting = set(), ["index.html"]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        text, folder = (WEB / name).read_text(encoding="utf-8"), (WEB / name).parent
        named = re.findall(r"""(?:from|import|Worker|URL|href=|src=)[ (]*["']((?:\.\.?/)?[\w/.-]+\.js)["']""", text)
        waiting += [(folder / path).resolve().relative_to(WEB).as_posix() for path in named]
    there = {path.relative_to(WEB).as_posix() for path in WEB.rglob("*.js")}
    assert found - {"index.html"} == there
    assert len(there) > 20


def test_the_worker_asks_for_all_its_modules_at_once():
    """A module that only another one names would come a round trip later."""
    found, waiting = set(), ["stream.js"]
    while waiting:
        name = waiting.pop()
        found.add(name)
        named = re.findall(
            r"""^(?:import|\}|export) ?.*["'](\.\.?/[\w/.-]+\.js)["'];$""", (WEB / name).read_text(), re.MULTILINE
        )
        paths = {(WEB / name).parent.joinpath(path).resolve().relative_to(WEB).as_posix() for path in named}
        waiting += paths - found
    lists = re.findall(r"""const MO\w+ = "([^"]*)";""", (WEB / "stream-worker.js").read_text())
    assert {f"{name}.js" for text in lists for name in text.split()} == found
    assert "changes/residual.js" in found


@pytest.mark.parametrize(
    "page", [WEB / "index.html", *sorted(EXAMPLES.rglob("*.html"))], ids=lambda path: path.parent.name
)
def test_a_page_names_an_icon(page):
    """Without one a browser asks the server for /favicon.ico and reports that it is not there."""
    assert '<link rel="icon"' in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("example", sorted(EXAMPLES.rglob("*.js")), ids=lambda path: path.name)
def test_examples_import_what_a_package_exports(example):
    text = example.read_text(encoding="utf-8")
    for names, module in re.findall(r"""import \{ ([^}]*) \} from "\./site/([\w-]+\.js)";""", text):
        exported = set(re.findall(r"^export (?:const|class|function) (\w+)", (WEB / module).read_text(), re.MULTILINE))
        assert set(names.split(", ")) <= exported, module


def test_segments_hold_the_bytes_of_the_stream(tmp_path):
    stream = write(tmp_path / "s.gss")
    done = package(stream, tmp_path / "site")
    assert done.segments == 2
    data = stream.read_bytes()
    with StreamReader(stream) as reader:
        bodies = b"".join(data[e.offset : e.offset + e.size] for e in reader.frames)
    names = segments(tmp_path / "site")
    files = [tmp_path / "site" / name for name in names]
    parts = [file.read_bytes() for file in files]
    assert b"".join(part[16:] for part in parts) == bodies
    assert {part[:16] for part in parts} == {file_header()}
    frames = [tuple(reader.frames[i].frame for i in (0, -1)) for reader in map(StreamReader, files)]
    assert frames == [(0, 2), (3, 5)], "each is a stream of its own"
    assert sorted(p.name for p in (tmp_path / "site" / "segments").iterdir()) == sorted(Path(n).name for n in names)


def test_streams_of_an_older_minor_version_keep_their_bytes(tmp_path):
    """Regression: with packet format 2.1 a stream of 2.0 was refused, although every player reads it."""
    stream = Path(__file__).parents[1] / "packet" / "samples" / "2.0" / "stream.gss"
    package(stream, tmp_path / "site")
    first = (tmp_path / "site" / segments(tmp_path / "site")[0]).read_bytes()
    assert first == stream.read_bytes()[: len(first)]
    with StreamReader(stream) as reader:
        assert reader.version == "2.0"


def test_the_poster_is_the_first_frame_and_the_page_names_it(tmp_path):
    stream = write(tmp_path / 'a "b" <i>.gss')
    package(stream, tmp_path / "site")
    with Playback(stream) as playback, Image.open(tmp_path / "site" / "poster.jpg") as poster:
        wanted = drawn(playback, playback.frames[0], playback.meta.background)
        assert psnr(wanted, np.asarray(poster)) > 30
    assert json.loads((tmp_path / "site" / "stream.json").read_text())["poster"] == "poster.jpg"
    page = (tmp_path / "site" / "index.html").read_text()
    name = "a &quot;b&quot; &lt;i&gt;"
    assert f"<title>{name}</title>" in page
    assert f"<h1>{name}</h1>" in page
    assert f'<meta property="og:title" content="{name}">' in page
    assert '<meta property="og:image" content="poster.jpg">' in page


def test_the_page_finds_every_module_that_it_names(tmp_path):
    package(write(tmp_path / "s.gss"), tmp_path / "site")
    for file in (tmp_path / "site").rglob("*.js"):
        for name in re.findall(r'(?:from|import|URL\()\s*\(?"(\.[^"]+)"', file.read_text()):
            assert (file.parent / name).is_file(), f"{file.name} imports {name}"
    assert 'import(new URL("./element.js"' in (tmp_path / "site" / "index.html").read_text()
    assert (tmp_path / "site" / "vendor" / "fzstd-LICENSE").is_file()


def test_nothing_of_the_player_is_fetched_from_elsewhere():
    for file in [*WEB.rglob("*.js"), *WEB.rglob("*.html")]:
        text = file.read_text()
        if "vendor" not in file.parts:
            assert not re.findall(r"https?://", text), file.name


def test_packaging_again_replaces_the_segments_and_nothing_else(tmp_path):
    package(write(tmp_path / "a.gss"), tmp_path / "site")
    before = segments(tmp_path / "site")
    (tmp_path / "site" / "notes.txt").write_text("mine")
    (tmp_path / "site" / "segments" / "mine.gss").write_bytes(b"mine")
    package(write(tmp_path / "b.gss", seed=5), tmp_path / "site")
    after = segments(tmp_path / "site")
    assert not set(before) & set(after)
    left = {f"segments/{p.name}" for p in (tmp_path / "site" / "segments").iterdir()}
    assert left == {*after, "segments/mine.gss"}
    assert (tmp_path / "site" / "notes.txt").read_text() == "mine"


def test_a_manifest_cannot_make_it_remove_files_elsewhere(tmp_path):
    stream = write(tmp_path / "a.gss")
    package(stream, tmp_path / "site")
    victim = write(tmp_path / "victim.gss", seed=6)
    manifest = json.loads((tmp_path / "site" / "stream.json").read_text())
    manifest["segments"].append({"frames": [9, 9], "file": "../victim.gss", "bytes": 1})
    manifest["segments"].append({"frames": [9, 9], "file": "segments/../../victim.gss", "bytes": 1})
    (tmp_path / "site" / "stream.json").write_text(json.dumps(manifest))
    package(stream, tmp_path / "site")
    assert victim.exists()


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    stream = write(tmp_path / "s.gss")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "precious.txt").write_text("mine")
    with pytest.raises(OutputError, match="no package"):
        package(stream, tmp_path / "site")
    assert [p.name for p in (tmp_path / "site").iterdir()] == ["precious.txt"]
    with pytest.raises(OutputError):
        package(stream, stream)


def test_renditions_must_have_the_same_frames(tmp_path):
    main = write(tmp_path / "main.gss")
    small = write(tmp_path / "small.gss", number=10)
    short = write(tmp_path / "short.gss", frames=5)
    done = package(main, tmp_path / "site", renditions=[small])
    manifest = json.loads((tmp_path / "site" / "stream.json").read_text())
    assert done.segments == 4
    assert [(r["name"], r["gaussians"]) for r in (manifest, *manifest["renditions"])] == [("main", 30), ("small", 10)]
    with pytest.raises(InputError, match="expected frames 6"):
        package(main, tmp_path / "other", renditions=[short])
    assert not (tmp_path / "other").exists(), "a package that failed leaves nothing"
    before = {path: path.read_bytes() for path in (tmp_path / "site").rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="expected frames 6"):
        package(write(tmp_path / "another.gss", seed=9), tmp_path / "site", renditions=[short])
    after = {path: path.read_bytes() for path in (tmp_path / "site").rglob("*") if path.is_file()}
    assert after == before, "and the package that was there as it was"


def test_a_damaged_stream_is_not_packaged(tmp_path):
    stream = write(tmp_path / "s.gss")
    data = bytearray(stream.read_bytes())
    data[len(data) // 2] ^= 1
    stream.write_bytes(bytes(data))
    with pytest.raises(PacketError):
        package(stream, tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_the_command_says_how_to_look(tmp_path, capsys):
    stream = write(tmp_path / "s.gss")
    shutil.copy(stream, tmp_path / "second.gss")
    command = ["export", str(stream), "--out", str(tmp_path / "site"), "--rendition", str(tmp_path / "second.gss")]
    assert run_command(command) == 2, "a rendition of something that is no page"
    assert run_command([*command, "--format", "page", "--frames", "0:2"]) == 2
    assert not (tmp_path / "site").exists()
    assert run_command([*command, "--format", "page"]) == 0
    out = capsys.readouterr().out
    assert "2 segments" in out, "equal segments are one file"
    assert "http.server" in out
