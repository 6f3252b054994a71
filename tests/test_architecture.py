"""The walls of the house: who imports whom, what stays cheap, how long a file may be, what must be documented."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from tools.reference.api import DOORS, exported
from tools.reference.pages import BUILT, TRACKED, write
from tools.reference.text import NOTE

ROOT = Path(__file__).parents[1]
FOLDERS = [ROOT / "gsstream", ROOT / "tools", *sorted((ROOT / "plugins").glob("*/src"))]
LIBRARY = sorted(path for folder in FOLDERS for path in folder.rglob("*.py"))
MAX_FILE, MAX_FUNCTION = 300, 60

#: What must import without torch: listing parts stays cheap, and the player runs where there is no torch.
TORCH_FREE = tuple(f"gsstream.{room}" for room in ("spec", "plugins", "recipe", "player", "packet", "serve", "core"))


def test_import_contracts() -> None:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as main; main()", "--no-cache"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert " 0 broken" in result.stdout


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
    names = modules_below(TORCH_FREE)
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(name)\n"
        "    if 'torch' in sys.modules: sys.exit(f'{name} imports torch')\n"
    )
    command = [sys.executable, "-c", code, *names]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(names) > 30


def violations(check: Callable[[ast.Module], Iterator[tuple[int, str]]]) -> list[str]:
    """"file:line: what" of every fault a check finds in the library."""
    found = []
    for path in LIBRARY:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [f"{path.relative_to(ROOT)}:{line}: {what}" for line, what in check(tree)]
    return found


def test_files_are_short() -> None:
    assert len(LIBRARY) > 100, "the sources were not found"
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in LIBRARY}
    assert not {name: length for name, length in lengths.items() if length > MAX_FILE}


def test_functions_are_short() -> None:
    def check(tree: ast.Module) -> Iterator[tuple[int, str]]:
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if length > MAX_FUNCTION:
                    yield node.lineno, f"{node.name} has {length} lines"

    assert violations(check) == []


def test_no_silent_repair() -> None:
    def check(tree: ast.Module) -> Iterator[tuple[int, str]]:
        for node in ast.walk(tree):
            if isinstance(node, ast.ExceptHandler) and node.type is None:
                yield node.lineno, "a bare except hides everything"
            if isinstance(node, ast.Attribute) and node.attr == "nan_to_num":
                yield node.lineno, "nan_to_num hides the cause"

    assert violations(check) == []


def test_public_names_have_docstrings() -> None:
    def check(tree: ast.Module) -> Iterator[tuple[int, str]]:
        if tree.body and not ast.get_docstring(tree):
            yield 1, "the module says nothing about itself"
        for node in tree.body:
            named = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith(("_", "gsstream_"))
            if named and not ast.get_docstring(node):
                yield node.lineno, f"{node.name} has no docstring"

    assert violations(check) == []


@pytest.mark.parametrize("page", TRACKED)
def test_reference_pages_say_what_the_code_says(page: str) -> None:
    written = (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8")
    assert written == TRACKED[page](), "run: make docs"


def test_the_other_reference_pages_are_built_and_not_tracked(tmp_path: Path) -> None:
    ignored = (ROOT / "docs" / "reference" / ".gitignore").read_text(encoding="utf-8").split()
    assert {name for name in ignored if name.endswith(".md")} == {f"/{name}" for name in BUILT}
    for path in write(tmp_path):
        text = path.read_text(encoding="utf-8")
        assert text.startswith(NOTE), f"{path.name} does not say that it is made"
        assert len(text.splitlines()) > 50, f"{path.name} is all but empty"
        assert " at 0x" not in text, f"{path.name} differs from run to run: it holds an address"


@pytest.mark.parametrize("door", DOORS)
def test_every_exported_name_has_its_own_docstring(door: str) -> None:
    names = exported(door)
    assert len(names) >= 10
    for name, value in names.items():
        if inspect.isclass(value) or inspect.isroutine(value):
            own = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
            assert own, f"gsstream.{door}.{name} has no docstring"


def settings(model: type[BaseModel], name: str):
    for key, field in model.model_fields.items():
        yield f"{name}.{key}", field
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from settings(field.annotation, f"{name}.{key}")


def test_every_setting_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsstream.core.kinds import CONTRACTS
    from gsstream.plugins.catalog import load_catalog
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


#: Written by people: not the pages made from the code, nor the reports of sweeps.
PROSE = [
    path
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if path.name != "report.md" and not path.read_text(encoding="utf-8").startswith("<!-- Made by")
]
MAX_PROSE = 125


def prose_of(text: str) -> Iterator[tuple[int, str]]:
    """Numbered lines of a page that are neither tables, nor code, nor pictures."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        fence = line.lstrip().startswith("```")
        fenced ^= fence
        if not (fence or fenced or line.startswith(("|", "    ", "!["))):
            yield number, line


def test_lines_of_prose_are_short() -> None:
    """A sentence begins on a line of its own where a paragraph would be too wide: a change then shows what changed."""
    assert len(PROSE) > 50, "the pages were not found"
    lines = [(path, number, line) for path in PROSE for number, line in prose_of(path.read_text(encoding="utf-8"))]
    assert [f"{p.relative_to(ROOT)}:{n}: {len(line)}" for p, n, line in lines if len(line) > MAX_PROSE] == []


def test_decisions_have_one_form() -> None:
    pages = sorted((ROOT / "docs" / "adr").glob("[0-9]*.md"))
    index = (ROOT / "docs" / "adr" / "README.md").read_text(encoding="utf-8")
    for page in pages:
        text = page.read_text(encoding="utf-8")
        title, status = text.splitlines()[0], text.splitlines()[2]
        assert re.fullmatch(rf"# {page.name[:4]} .*[^.]", title), f"{page.name}: no title '# NUMBER Title': {title!r}"
        assert status.startswith("Status: "), f"{page.name}: the third line says the status"
        sections = re.findall(r"^## (.*)$", text, re.MULTILINE)
        assert sections == ["Situation", "Decision", "Why", "What follows"], f"{page.name}: {sections}"
        assert f"({page.name})" in index, f"docs/adr/README.md does not list {page.name}"
    assert len(pages) >= 12


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
