"""The command line as its user meets it: listings, messages, exit codes, the frozen list of options."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from gsstream.cli.main import app, run_command
from gsstream.cli.table import whole_table
from gsstream.discovery.builtin import gsstream_commands

CHEAP = [
    ["--help"],
    ["--version"],
    ["methods"],
    ["methods", "dense"],
    ["plugins"],
    ["run", "--help"],
    ["play", "--help"],
    ["evaluate", "--help"],
    ["info", "--help"],
    ["export", "--help"],
    ["open", "--help"],
    ["recipe", "dense"],
]

RUN = ["run", "--source", "demo", "--out", "OUT"]
SLOW = [*RUN, "--set", "renderer=reference"]

OPTIONS = {
    "gsstream": ["--debug", "--version", "--install-completion", "--show-completion"],
    "gsstream run": [
        "--source", "--out", "--method", "--recipe", "--set", "--budget", "--frames", "--scale", "--first-frame",
        "--resume", "--overwrite", "--no-video", "--no-pictures", "--quiet", "--serve", "--renderer",
    ],
    "gsstream scene": [],
    "gsstream scene prepare": [
        "RAW", "--out", "--test", "--lens", "--each", "--frames", "--width", "--without", "--fps", "--quiet",
    ],
    "gsstream scene validate": ["SCENE", "--frames", "--no-features"],
    "gsstream play": ["STREAM", "--out", "--camera", "--frames", "--fps", "--size", "--renderer", "--max-memory"],
    "gsstream open": ["STREAM", "--live", "--host", "--port", "--token", "--viewers", "--origin"],
    "gsstream export": [
        "STREAM", "--out", "--format", "--frames", "--max-memory", "--origin", "--rendition", "--join-every",
    ],
    "gsstream info": ["STREAM", "--json"],
    "gsstream evaluate": [
        "STREAM", "--source", "--frames", "--lpips-onnx", "--lpips-range", "--protocol", "--json", "--max-memory",
    ],
    "gsstream methods": ["NAME", "--full"],
    "gsstream recipe": ["METHOD", "--recipe", "--set", "--full", "--schema"],
    "gsstream plugins": ["PART", "--check"],
    "gsstream doctor": [],
    "gsstream check": ["NAME", "--quiet", "--set", "--source"],
    "gsstream conformance": ["--program", "--vectors"],
    "gsstream new-plugin": ["NAME", "--kind", "--out"],
}  # fmt: skip
#: Most of each that gsstream itself may have; what measures is in gsstream-lab.
COMMANDS, ALL_OPTIONS = 15, 72


@pytest.fixture(autouse=True)
def _no_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "")


def options_of(command, path: str) -> dict[str, list[str]]:
    shown = [p for p in command.params if p.name != "help"]
    own = {path: [p.opts[0] if p.param_type_name == "option" else p.name.upper() for p in shown]}
    for name, child in getattr(command, "commands", {}).items():
        own |= options_of(child, f"{path} {name}")
    return own


def test_options_are_frozen() -> None:
    """A new option is a promise: add it here on purpose, or make it a recipe key."""
    found = options_of(whole_table(app), "gsstream")
    assert {path: sorted(names) for path, names in found.items()} == {p: sorted(names) for p, names in OPTIONS.items()}


def test_there_are_few() -> None:
    commands = [path for path in OPTIONS if not any(other.startswith(f"{path} ") for other in OPTIONS)]
    assert len(commands) <= COMMANDS
    assert sum(name.startswith("--") for names in OPTIONS.values() for name in names) <= ALL_OPTIONS


def test_the_listing_says_what_the_help_says() -> None:
    for spec in gsstream_commands():
        assert get_command(app).get_command(None, spec.name).help.strip().splitlines()[0] == spec.summary


def test_every_option_says_what_it_does() -> None:
    def walk(command):
        yield from ((command.name, param) for param in command.params)
        for child in getattr(command, "commands", {}).values():
            assert child.help, f"{child.name} has no help"
            yield from walk(child)

    for command, param in walk(whole_table(app)):
        assert getattr(param, "help", None), f"{command} {param.name} has no help"


IN_TURN = """
import contextlib, io, json, sys
from gsstream.cli.main import run_command
heavy = {"torch", "kornia", "matplotlib", "constriction", "pycolmap", "av", "onnxruntime"}
for args in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as said:
        code = run_command(args)
    print(code, bool(said.getvalue()), sorted(heavy & set(sys.modules)), *args)
"""


def test_cheap_commands_import_no_torch() -> None:
    """One after the other in one process: the first that imports one of them stands out."""
    command = [sys.executable, "-c", IN_TURN, json.dumps(CHEAP)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert result.stderr == ""
    assert result.stdout.splitlines() == [" ".join(["0 True []", *args]) for args in CHEAP]


@pytest.mark.parametrize(
    ("words", "offered"), [("gsstream ex", "export"), ("gsstream export --format s", "spz\nsequence")]
)
def test_a_shell_completes_names_and_choices(words: str, offered: str) -> None:
    settings = {"_GSSTREAM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    command = [sys.executable, "-c", "from gsstream.cli.main import main; main()"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, env=os.environ | settings)
    assert (done.stdout.strip(), done.stderr) == (offered, "")


def test_the_help_begins_with_an_example(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It is as wide as the terminal, and what it tells to run is what the parser takes."""
    monkeypatch.setenv("COLUMNS", "130")
    code, out, _ = run(capsys, "--help")
    assert code == 0
    begin = out.splitlines()[-1].strip()
    for line in begin.removeprefix("Begin with: ").split(", then: "):
        _, name, *options = line.split()
        assert set(options) <= {*OPTIONS[f"gsstream {name}"], "demo", "runs/demo"}
    assert max(map(len, out.splitlines())) > 80


def run(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, str, str]:
    code = run_command(args)
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([*RUN, "--method", "dens"], "no method named 'dens'; did you mean 'dense'?"),
        ([*RUN, "--set", "rendrer=cpu"], "--set rendrer=cpu: unknown key 'rendrer'; did you mean 'renderer'?"),
        ([*SLOW, "--set", "gate=always-opne"], "--set gate=always-opne: gate.name: no gate named 'always-opne'; did"),
        ([*RUN, "--set", "renderer=referense"], "--set renderer=referense: renderer.name: no renderer named 'referen"),
        ([*SLOW, "--set", "gate.temperatur=1"], "--set gate.temperatur=1: unknown key 'gate.params.temperatur'; none"),
        ([*SLOW, "--source", "dmo"], "source 'dmo': no such folder and no known scheme; expected 'demo'"),
        ([*SLOW, "--source", "synthetic:frame=3"], "synthetic source: unknown option 'frame'; did you mean 'frames'?"),
        ([*SLOW, "--first-frame", "absent.gss"], "no stream at absent.gss: expected a .gss file or the output folder"),
        ([*RUN, "--frames", "0"], "--frames frames=0: frames: input should be greater than or equal to 1, got 0"),
        ([*RUN, "--recipe", "absent.yaml"], "cannot read the recipe absent.yaml: "),
        ([*RUN, "--budget", "siz=20KB"], "--budget siz=20KB: unknown key 'siz'; did you mean 'size'?"),
        (
            [*RUN, "--budget", "size=20kb"],
            "--budget budget.size=20kb: budget.size: no unit 'kb' here; did you mean 'KB'?, got '20kb'",
        ),
        (["info", "absent.gss"], "no stream at absent.gss: expected a .gss file or the output folder of a run"),
        (["play", "absent.gss", "--out", "x", "--frames", "5:2"], "--frames 5:2: expected A:B with A < B, e.g. 0:30"),
        (["plugins", "additiv"], "no part named 'additiv'; did you mean 'additive'?"),
        (["plugins", "gatte/additive"], "no kind of part named 'gatte'; did you mean 'gate'?"),
        (["methods", "s2g"], "no method named 's2g'; known: dense"),
    ],
)
def test_mistakes_end_with_one_line_and_code_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, args: list[str], message: str
) -> None:
    code, out, err = run(capsys, *[str(tmp_path / "out") if arg == "OUT" else arg for arg in args])
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {message}")
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists(), "a refused command leaves nothing behind"


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "--debug", "methods", "nobody")
    assert code == 2
    assert "Traceback (most recent call last)" in err
    assert "UnknownName: no method named 'nobody'" in err


@pytest.mark.parametrize("args", [["frob"], ["run", "--sorce", "demo"], ["run"], ["play"]])
def test_usage_errors_have_code_2(capsys: pytest.CaptureFixture[str], args: list[str]) -> None:
    code, _, err = run(capsys, *args)
    assert code == 2
    assert "Error: " in err


def test_interrupts_have_code_130(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gsstream.discovery.catalog.discover", interrupt)
    assert run(capsys, "methods") == (130, "", "interrupted\n")


def test_show_lists_every_setting_with_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "plugins", "flat")
    assert code == 0
    assert "structure flat (from gsstream 0.1.0): each Gaussian is its own node" in out
    (row,) = [line for line in out.splitlines() if line.startswith("resolution ")]
    assert "integer >= 1, <= 65536" in row
    assert " 1024 " in row
    nested = [line.split()[:1] for line in run(capsys, "plugins", "update/additive")[1].splitlines()]
    first = nested.index(["SETTING"]) + 1
    assert nested[first : first + 2] == [["means.step"], ["means.lr"]]


def test_methods_show_names_parts_and_their_origin(capsys: pytest.CaptureFixture[str]) -> None:
    out = run(capsys, "methods", "dense")[1]
    (row,) = [line for line in out.splitlines() if line.startswith("gate ")]
    assert row.split()[:4] == ["gate", "always-open", "gsstream", "0.1.0"]


def test_recipe_show_checks_parts_when_asked(capsys: pytest.CaptureFixture[str]) -> None:
    typo = ["recipe", "dense", "--set", "renderer=reference", "--set", "structure.resoluton=2"]
    assert run(capsys, *typo)[0] == 0
    code, _, err = run(capsys, *typo, "--full")
    assert code == 2
    assert err.endswith("unknown key 'structure.params.resoluton'; did you mean 'resolution'?\n")


def test_full_listing_says_value_source_default_and_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    out = run(capsys, "methods", "dense", "--full")[1]
    rows = {line.split()[0]: line for line in out.splitlines() if line}
    assert rows["stream.epochs"].split()[1:4] == ["20", "default", "20"]
    assert rows["gate.name"].split()[1:5] == ["'always-open'", "method", "dense", "'always-open'"]
    resolution = rows["structure.params.resolution"]
    assert resolution.split()[1:4] == ["1024", "default", "1024"]
    assert "integer >= 1, <= 65536" in resolution
    assert resolution.endswith("position residuals are measured in (the length named by unit / resolution); 1 to 65536")
    assert "update.params.means.step" in rows
    assert "renderer.params" not in out


def test_show_says_which_methods_set_what(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("base: dense\nstructure: {name: flat, params: {resolution: 77}}\n")
    from gsstream.discovery.catalog import Catalog

    found = Catalog.recipe_path
    monkeypatch.setattr(Catalog, "names", lambda _, kind: ["dense", "mine"] if kind == "method" else ["flat"])
    monkeypatch.setattr(Catalog, "recipe_path", lambda self, name: recipe if name == "mine" else found(self, name))
    rows = [line.split() for line in run(capsys, "plugins", "structure/flat")[1].splitlines()]
    assert ["dense", "-", "-", "all", "defaults"] in rows
    assert ["mine", "resolution", "77", "method", "mine"] in rows


def test_what_a_file_says_is_shown_and_not_obeyed() -> None:
    """Texts of streams and recordings reach the terminal: no escape sequence and no forged line may come through."""
    from gsstream.cli.listing import printable

    hostile = "a\x1b]0;title\x07b\r\ncameras 99\ud800\u2028end\x9b2J"
    shown = printable(hostile)
    assert shown.isprintable()
    assert shown.isascii()
    assert "\\x1b]0;title\\x07" in shown
    assert printable("Größe 30 µm ✓") == "Größe 30 µm ✓"
    assert printable("two\nlines\x1b", keep="\n") == "two\nlines\\x1b"


def test_info_of_a_stream_with_terminal_escapes(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    from gsstream.core.cameras import Cameras
    from gsstream.core.changes import Layout
    from gsstream.core.gaussians import Gaussians
    from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_key

    rig = Cameras(("cam",), np.eye(4)[None], np.diag([8.0, 8.0, 1.0])[None], 8, 8)
    meta = StreamMeta("x\x1b[2J\n  forged     1", "\x07", {}, rig, rig.select([]), 30.0)
    f32 = {
        name: np.zeros((1, *shape), np.float32)
        for name, shape in {"means": (3,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}.items()
    }
    scene = Gaussians(quats=np.float32([[1, 0, 0, 0]]), **f32)
    layout = Layout(np.int32([1]), np.uint8([0]), np.float32([1]))
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        writer.append(encode_key(KeyState(scene, layout, meta)))
    assert run_command(["info", str(tmp_path / "s.gss")]) == 0
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "\x07" not in said
    assert "\n  forged" not in said
