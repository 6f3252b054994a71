"""What is missing can be installed by the command that the error gives."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from gsstream.cli.main import run_command
from gsstream.core import install_hints
from gsstream.core.install_hints import ENCODER, TABLE, install, install_any, install_part, install_renderer, page
from gsstream.discovery.catalog import load_catalog
from tools.shipped import table

ROOT = Path(__file__).parents[2]
#: Where messages name extras.
PLACES = ("gsstream", "plugins/lab/src")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {name: [Requirement(text) for text in texts] for name, texts in PROJECT["optional-dependencies"].items()}


def brought_by(extra: str) -> set[str]:
    """Return the distributions that an extra installs, those of the extras it names included."""
    found: set[str] = set()
    for requirement in EXTRAS[extra]:
        if requirement.name == "gsstream":
            found = found.union(*map(brought_by, requirement.extras))
        else:
            found.add(requirement.name)
    return found


def test_every_part_of_the_other_distributions_is_brought_by_the_extra_that_is_named() -> None:
    """The file is made, and lies in the wheel of gsstream: the plugins are not there when it is read."""
    named = json.loads(TABLE.read_text(encoding="utf-8"))
    assert named == table(), "written anew by python -m tools.shipped"
    entries = {f"{kind}/{name}": entry.distribution for (kind, name), entry in load_catalog().entries.items()}
    for extra, keys in named.items():
        assert {entries[key] for key in keys} <= brought_by(extra)
    assert sum(map(len, named.values())) > 20
    assert {"player", "s2gs", "gpu", "methods", "capture"} == set(named)


#: Files in which a plugin of this repository is named by hand -> how often. In pyproject.toml: packages and layers of
#: the import rules, and an extra. Everything else follows from its folder.
BY_HAND = {"pyproject.toml": 3, "requirements.txt": 1, "plugins/README.md": 1}
#: The renderer is built in a folder that ruff leaves out; the lab has rules and extras of its own, and it and what
#: captures enter by more than the front doors.
OTHERWISE = {"cpu_render": 4, "lab": 7, "capture": 5}


@pytest.mark.parametrize("folder", sorted(path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml")))
def test_a_plugin_of_this_repository_is_named_in_few_lists(folder: str) -> None:
    name = re.compile(
        rf"(?<![\w-])(?:gsstream[_-]{folder.replace('_', '[_-]')}|plugins/{folder}|{folder}/README\.md)(?![\w-])"
    )
    expected = {**BY_HAND, "pyproject.toml": OTHERWISE.get(folder, BY_HAND["pyproject.toml"])}
    assert {file: len(name.findall((ROOT / file).read_text(encoding="utf-8"))) for file in BY_HAND} == expected


def test_extras_that_messages_name_exist() -> None:
    texts = "".join(path.read_text(encoding="utf-8") for place in PLACES for path in (ROOT / place).rglob("*.py"))
    named = set(re.findall(r"install_extra\(['\"](\w+)['\"]\)", texts))
    assert {"video", "sfm", "ray", "player", "s2gs"} <= named <= set(EXTRAS)
    assert set(ENCODER) <= brought_by("s2gs")
    assert not set(ENCODER) & ({Requirement(text).name for text in PROJECT["dependencies"]} | brought_by("player"))
    assert brought_by("methods") >= brought_by("s2gs")


def test_the_command_is_of_the_environment_that_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert install("gsstream[video]") == f"{sys.executable} -m pip install 'gsstream[video]'"
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    monkeypatch.setattr("shutil.which", lambda name: str(Path(sys.executable).parent / name))
    assert install("gsstream[video]") == "pip install 'gsstream[video]'"
    assert install_part("gate", "nobodys") is None
    folder = install_renderer().rpartition(" ")[2].strip("'")
    assert (Path(folder) / "CMakeLists.txt").is_file()


def test_what_no_index_has_comes_from_sources_or_wheels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(install_hints, "_is_installed", lambda name: name == "gsstream-lab")
    words = shlex.split(install("gsstream[s2gs,video]"))
    folders = [word for before, word in itertools.pairwise(words) if before == "-e"]
    assert folders == [f"{ROOT}[s2gs,video]", *(str(ROOT / "plugins" / name) for name in ("cpu_render", "s2gs"))]
    assert all((Path(folder.partition("[")[0]) / "pyproject.toml").is_file() for folder in folders)
    assert install("gsstream-gsplat-render[cuda]").endswith(f"-e '{ROOT / 'plugins' / 'gsplat_render[cuda]'}'")
    assert install("gsstream[video]").endswith("install 'gsstream[video]'"), "every index has PyAV"
    monkeypatch.setattr(install_hints, "SOURCES", tmp_path)
    assert "install --find-links DIST 'gsstream[s2gs]', where DIST is the folder of wheels" in install("gsstream[s2gs]")
    monkeypatch.setattr(install_hints, "ON_INDEX", True)
    assert install("gsstream[s2gs]").endswith("install 'gsstream[s2gs]'")


@pytest.mark.parametrize("driver", [False, True])
@pytest.mark.parametrize(
    "requirement", ["gsstream[s2gs]", "gsstream[encoder]", "gsstream[methods,video]", "gsstream[video]"]
)
def test_without_a_gpu_the_cpu_build_of_torch_comes_first(
    monkeypatch: pytest.MonkeyPatch, requirement: str, driver: bool
) -> None:
    monkeypatch.setattr(install_hints, "_is_installed", lambda name: name != "torch")
    monkeypatch.setattr(install_hints, "finds_gpu", lambda: driver)
    monkeypatch.setattr("sys.platform", "linux")
    wanted = not driver and requirement != "gsstream[video]"
    assert install(requirement).startswith("there is no NVIDIA GPU here: install the CPU build") == wanted
    assert install(requirement).endswith(f"install '{requirement}'")
    assert ("pytorch.org" in install_any()) == (not driver)
    monkeypatch.setattr("sys.platform", "darwin")
    assert "pytorch.org" not in install(requirement) + install_any()


def test_commands_of_the_lab_are_known_where_it_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = {
        name: extra
        for extra, keys in json.loads(TABLE.read_text()).items()
        for name in (key.removeprefix("command/") for key in keys)
        if "/" not in name
    }
    alone = [plugin for plugin in load_catalog().plugins if plugin.name == "builtin"]
    monkeypatch.setattr("gsstream.cli.table.load_catalog", lambda: load_catalog(alone))
    assert len(shipped) > 6
    for name, extra in shipped.items():
        assert run_command([name, "x"]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"error: the command {name!r} is not installed here. To install it: ")
        assert said.rstrip().endswith(f"'gsstream[{extra}]'")
    assert run_command(["compaer"]) == 2
    assert "not installed" not in capsys.readouterr().err


def test_pages_that_messages_name_are_there() -> None:
    texts = "".join(path.read_text(encoding="utf-8") for place in PLACES for path in (ROOT / place).rglob("*.py"))
    named = re.findall(r"\{?page\(['\"]([\w/.-]+)['\"]\)", texts)
    assert len(named) >= 2
    assert all(Path(page(name)).is_file() for name in named)


def test_a_shipped_method_that_is_not_installed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    catalog = load_catalog([plugin for plugin in load_catalog().plugins if plugin.name == "builtin"])
    with pytest.raises(ValueError, match=r"no method named 's2gs-fast'; .*\. To install it: .*'gsstream\[s2gs\]'"):
        catalog.recipe_path("s2gs-fast")
    with pytest.raises(ValueError, match=r"no method named 's3gs'; known: dense, hold$"):
        catalog.recipe_path("s3gs")
    assert run_command(["run", "--method", "s3gs", "--source", "demo", "--out", str(tmp_path / "o")]) == 2
    assert "pip install" not in capsys.readouterr().err


COMMANDS = (
    "run --source demo --out o", "check s2gs", "bench frame", "scene validate demo",
    "compare dense,hold --source demo --out o", "tune --budget size=9KB --source demo --out o",
    "sweep absent.yaml --out o", "report absent", "search --method dense --source demo --out o", "gap absent",
)  # fmt: skip


def test_commands_of_the_encoder_say_what_to_install(tmp_path: Path) -> None:
    code = (
        f"import sys\nfor name in {ENCODER}: sys.modules[name] = None\n"
        "from gsstream.cli.main import run_command\n"
        "for command in sys.argv[1:]: print(run_command(command.split()), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *COMMANDS], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    said = done.stderr.splitlines()
    assert len(said) == 2 * len(COMMANDS), done.stderr
    for command, line, code in zip(COMMANDS, said[::2], said[1::2], strict=True):
        assert re.search(r"this needs \w+, which is not installed.*pip install 'gsstream\[s2gs\]'", line), command
        assert code == "1"
