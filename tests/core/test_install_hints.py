"""What is missing can be installed by the command that the error gives."""

from __future__ import annotations

import itertools
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
from gsstream.core.install_hints import ENCODER, SHIPPED, install, install_part, install_renderer, page
from gsstream.discovery.catalog import load_catalog

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
    ours = {tomllib.loads(path.read_text())["project"]["name"] for path in ROOT.glob("plugins/*/pyproject.toml")}
    entries = {f"{kind}/{name}": entry for (kind, name), entry in load_catalog().entries.items()}
    shipped = {key: entry.distribution for key, entry in entries.items() if entry.distribution in ours}
    assert len(shipped) > 20, "the plugins of this repository are not installed"
    named = {key: extra for extra, keys in SHIPPED.items() for key in keys}
    assert set(named) == set(shipped)
    for key, extra in named.items():
        assert shipped[key] in brought_by(extra), f"{key}: the extra {extra!r} does not bring {shipped[key]}"


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
