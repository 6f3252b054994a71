"""The walls of the house: what imports what, what stays cheap, how long a file may be, what must be documented."""

from __future__ import annotations

import ast
import io
import os
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from pydantic import BaseModel

from tools.reference.pages import PAGES, write
from tools.reference.text import NOTE

ROOT = Path(__file__).parents[1]
FOLDERS = [ROOT / "gsstream", ROOT / "tools", *sorted((ROOT / "plugins").glob("*/src"))]
LIBRARY = sorted(path for folder in FOLDERS for path in folder.rglob("*.py"))
#: Lines of code, without docstrings, comments and blank lines; and all lines of a function.
MAX_FILE, MAX_FUNCTION = 240, 60

#: Where ``Exception`` alone is caught: the code of libraries, which does not leave the process. That of parts, sources
#: and other strangers may, and is caught by ``gsstream.core.errors.STRANGERS``.
LIBRARIES_ARE_CALLED = {
    *("lpips.py", "images.py", "doctor.py", "replay.py", "troubles.py", "kernels.py", "fused.py", "network.py"),
    "drive.py",  # the soak, which goes on
}

#: What must import without torch: listing parts stays cheap, and the player runs where there is no torch.
TORCH_FREE = tuple(f"gsstream.{room}" for room in ("spec", "discovery", "recipe", "player", "packet", "serve", "core"))


def modules_below(names: tuple[str, ...]) -> list[str]:
    found = ["gsstream"]
    for name in names:
        base = ROOT.joinpath(*name.split("."))
        paths = base.rglob("*.py") if base.is_dir() else [base.with_suffix(".py")]
        for path in sorted(paths):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found


def test_these_rooms_import_no_torch() -> None:
    """Nor do plugins that declare what they hold."""
    names = modules_below(TORCH_FREE)
    names += [f"{path.parent.name}.plugin" for path in sorted((ROOT / "plugins").glob("*/src/*/plugin.py"))]
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    module = importlib.import_module(name)\n"
        "    if name.endswith('.plugin'): getattr(module, 'gsstream_components', list)()\n"
        "    if 'torch' in sys.modules: sys.exit(f'{name} imports torch')\n"
    )
    command = [sys.executable, "-c", code, *names]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(names) > 30


def code_lines(source: str) -> int:
    """Count the lines that hold code: no docstring, no comment, not blank."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if ast.get_docstring(node) is not None and first is not None:
                docstrings.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    found = {line for t in tokens if t.type not in silent for line in range(t.start[0], t.end[0] + 1)}
    return len(found - docstrings)


def test_code_lines_are_counted_as_a_reader_would() -> None:
    source = '"""Module."""\n# comment\n\ndef f():\n    """Doc\n    string."""\n    return (  # why\n        1)\n'
    assert code_lines(source) == 3


def test_files_are_short() -> None:
    assert len(LIBRARY) > 100, "the sources were not found"
    lengths = {str(path.relative_to(ROOT)): code_lines(path.read_text(encoding="utf-8")) for path in LIBRARY}
    assert not {name: length for name, length in lengths.items() if length > MAX_FILE}


def test_functions_are_short_and_repair_nothing_in_silence() -> None:
    """Of every function its lines, of every handler and call what hides a cause or wastes; each file is parsed once."""

    catching: set[str] = set()

    def faults(path: Path, node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            if length > MAX_FUNCTION:
                yield f"{node.lineno}: {node.name} has {length} lines"
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            yield f"{node.lineno}: a bare except hides everything"
        if isinstance(node, ast.ExceptHandler) and isinstance(node.type, ast.Name) and node.type.id == "Exception":
            catching.add(path.name)
        if isinstance(node, ast.Attribute) and node.attr == "nan_to_num":
            yield f"{node.lineno}: nan_to_num hides the cause"
        named = {keyword.arg for keyword in node.keywords} if isinstance(node, ast.Call) else set()
        called = ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""
        if called in ("to_ndarray", "to_image", "to_rgb", "reformat") and "threads" not in named:
            yield f"{node.lineno}: without threads=1 each picture of a film starts a pool of threads"

    trees = {path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8")) for path in LIBRARY}
    nodes = [(path, node) for path, tree in trees.items() for node in ast.walk(tree)]
    assert [f"{path}:{fault}" for path, node in nodes for fault in faults(path, node)] == []
    assert catching == LIBRARIES_ARE_CALLED


@pytest.mark.parametrize("page", PAGES)
def test_reference_pages_say_what_the_code_says(page: str) -> None:
    written = (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8")
    assert written == PAGES[page](), "run: make docs"


def test_reference_pages_say_that_they_are_made_and_are_the_same_everywhere(tmp_path: Path) -> None:
    for path in write(tmp_path):
        text = path.read_text(encoding="utf-8")
        assert text.startswith(NOTE), f"{path.name} does not say that it is made"
        assert len(text.splitlines()) > 50, f"{path.name} is all but empty"
        assert " at 0x" not in text, f"{path.name} differs from run to run: it holds an address"


def settings(model: type[BaseModel], name: str):
    for key, field in model.model_fields.items():
        yield f"{name}.{key}", field
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from settings(field.annotation, f"{name}.{key}")


def test_every_setting_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsstream.core.kinds import CONTRACTS
    from gsstream.discovery.catalog import load_catalog
    from gsstream.recipe.model import Recipe

    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "")
    catalog = load_catalog()
    models = {"recipe": Recipe}
    models |= {f"{k}/{n}": catalog.resolve(k, n).Config for k, n in catalog.entries if k in CONTRACTS}
    for name, model in models.items():
        assert model.model_config.get("extra") == "forbid", f"{name} accepts unknown keys"
        assert model.model_config.get("frozen"), f"{name} can be changed after it was checked"
        for key, field in settings(model, name):
            assert field.description, f"{key} has no description"


def test_the_requirements_cover_every_distribution_of_this_repository() -> None:
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    for project in [ROOT, *(path.parent for path in sorted((ROOT / "plugins").glob("*/pyproject.toml")))]:
        folder = project.relative_to(ROOT).as_posix()
        assert f"-e {folder}" in lines
    documented = (ROOT / "docs" / "dependencies.md").read_text()
    for line in lines:
        if line and not line.startswith(("#", "-e")):
            name, equals, _ = line.partition("==")
            assert equals, f"{line} is not pinned"
            assert f"`{name}`" in documented, f"docs/dependencies.md does not say why {name}"


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="runs in no worker, which keeps to one thread")
def test_a_worker_keeps_to_one_thread() -> None:
    """Libraries read the number when they are loaded: set after that, it would have no effect and nobody would see."""
    assert torch.get_num_threads() == int(os.environ["OMP_NUM_THREADS"])


def test_the_lists_of_conftest_name_files_that_exist() -> None:
    """A name that is gone is no error to pytest: the file would only be begun late, or left out of the quick tests."""
    source = ast.parse((ROOT / "conftest.py").read_text(encoding="utf-8"))
    texts = [n.value for n in ast.walk(source) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    names = [text for text in texts if "/test_" in text and " " not in text]
    assert len(names) > 40
    found = {path.with_suffix("").as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    found |= {path.with_suffix("").as_posix() for path in (ROOT / "plugins").glob("*/tests/test_*.py")}
    assert [name for name in names if not any(path.endswith(f"/{name}") for path in found)] == []


def test_no_two_files_of_the_tests_have_the_same_name() -> None:
    """Python finds these modules by their bare names: pytest refuses a second one, or takes its helpers."""
    folders = [ROOT / "tests", *sorted((ROOT / "plugins").glob("*/tests"))]
    paths = [path for folder in folders for path in folder.rglob("*.py") if not (path.parent / "__init__.py").exists()]
    assert len(paths) > 300
    found: dict[str, list[str]] = {}
    for path in paths:
        if path.name != "conftest.py":
            found.setdefault(path.name, []).append(path.relative_to(ROOT).as_posix())
    assert {name: where for name, where in found.items() if len(where) > 1} == {}
    assert {name.removesuffix(".py") for name in found} & sys.stdlib_module_names == set()
