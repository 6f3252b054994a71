"""What a page names exists: links, paths, recipe keys, commands with their options, methods.

A placeholder is written in capitals (`tests/FOLDER`, `--out DIR`, `--set SLOT.KEY=VALUE`) or as `...`.
"""

from __future__ import annotations

import ast
import functools
import itertools
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from gsstream.cli.main import app
from gsstream.cli.table import whole_table
from gsstream.core.kinds import CONTRACTS
from gsstream.core.log import PHASES
from gsstream.discovery.catalog import load_catalog
from gsstream.recipe.model import Recipe
from tools.reference.pages import FOLDER
from tools.reference.pages import PAGES as REFERENCE

ROOT = Path(__file__).parents[1]
#: Pages that are made from the code, whose sentences are looked at there.
MADE = {FOLDER / name for name in REFERENCE}
PAGES = sorted(
    {
        path
        for name in ("*", "docs/**/*", "configs/**/*", "*/README", "plugins/*/README")
        for path in ROOT.glob(f"{name}.md")
    }
    - MADE
)
#: Folders whose files pages may name by their path in the repository.
PLACES = "gsstream|plugins|tests|tools|docs|configs"
#: Options of other programs that pages name: pip, pytest, make and the like.
FOREIGN = {
    "--find-links", "--index-url", "--extra-index-url", "--no-build-isolation", "--no-deps", "--directory", "--bind",
    "--no-binary", "--orphan", "--output-dir",
}  # fmt: skip
#: Files in which a comment or a message may name a page.
SOURCES = {"", ".py", ".toml", ".yaml", ".js", ".mjs", ".cpp", ".hpp"}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?: {4}.*\n)+")
INLINE = re.compile(r"`([^`\n]+)`")
PLACEHOLDER = re.compile(r"(?=.*[A-Z])[A-Z0-9_]+|\.\.\.|…")


@functools.cache
def prose(page: Path) -> str:
    """A page without its fenced and indented blocks."""
    return INDENTED.sub("\n", FENCE.sub("\n", page.read_text(encoding="utf-8")))


@functools.cache
def shell_lines(page: Path) -> list[str]:
    """Lines of the blocks of a page that hold no other language, continued lines joined, comments taken off."""
    text = page.read_text(encoding="utf-8")
    blocks = [body for language, body in FENCE.findall(text) if language in ("", "bash", "sh", "console")]
    blocks += INDENTED.findall(FENCE.sub("\n", text))
    joined = "\n".join(blocks).replace("\\\n", "")
    return [line.strip().removeprefix("$ ") for line in joined.splitlines()]


def commands(lines: list[str]) -> Iterator[list[str]]:
    """The words after ``gsstream`` of every call of it."""
    for line in lines:
        try:
            words = shlex.split(line, comments=True)
        except ValueError:  # a line of another language, or a placeholder with an apostrophe
            continue
        call: list[str] = []
        for word in [*words, ";"]:
            ends = word.endswith(";") or word in ("&&", "|", "&", "||", ">")
            call += [word.rstrip(";")] if word.rstrip(";") and word not in ("&&", "|", "&", "||", ">") else []
            if ends and call:
                while "=" in call[0] and len(call) > 1:  # variables of the environment
                    call.pop(0)
                if call[0] == "gsstream" or call[0].endswith("bin/gsstream"):
                    yield call[1:]
                call = []


@functools.cache
def command_line() -> Any:
    return whole_table(app)


def problem(words: list[str], complete: bool) -> str | None:
    """What the command line would refuse of a call; values are not looked at.

    An incomplete call, in a sentence or with ``...`` in it, may leave out what is required.
    """
    command, path, rest = command_line(), "gsstream", list(words)
    complete = complete and "..." not in rest
    rest = [word for word in rest if word != "..."]
    if rest and rest[0] in ("--debug",):
        rest.pop(0)
    if not complete and rest and not re.fullmatch(r"[a-z][a-z-]+", rest[0]):
        return None  # the name and a number, not a call
    while getattr(command, "commands", None) and rest and not rest[0].startswith("-"):
        if PLACEHOLDER.fullmatch(rest[0]):
            return None
        if rest[0] not in command.commands:
            return f"{path} has no command {rest[0]!r}"
        path, command = f"{path} {rest[0]}", command.commands[rest.pop(0)]
    switches = [p for p in command.params if p.param_type_name == "option"]
    options = {text: switch for switch in switches for text in (*switch.opts, *switch.secondary_opts)}
    given, arguments = set(), 0
    while rest:
        word, equals, _ = rest.pop(0).partition("=")
        if word in ("-h", "--help"):
            return None
        if not re.match(r"--?[a-z]", word):
            arguments += 1
        elif word not in options:
            return f"{path} has no option {word}"
        else:
            given.add(options[word].name)
            if not options[word].is_flag and not equals:
                if not rest and complete:
                    return f"{path} {word} lacks its value"
                rest = rest[1:]
    positional = [p for p in command.params if p.param_type_name == "argument"]
    if arguments > len(positional) and all(p.nargs == 1 for p in positional):
        return f"{path} takes {len(positional)} arguments, not {arguments}"
    if complete:
        lacking = [p.opts[0] for p in switches if p.required and p.name not in given]
        lacking += [p.name for p in positional[arguments:] if p.required]
        if lacking:
            return f"{path} lacks {', '.join(lacking)}"
    return None


@functools.cache
def catalog() -> Any:
    return load_catalog()


def fields(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield f"{prefix}{name}"
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields(field.annotation, f"{prefix}{name}.")


@functools.cache
def recipe_keys() -> set[str]:
    """Every key that some recipe may have: those of the recipe, and those of every part in its slot."""
    keys = set(fields(Recipe))
    for kind, name in catalog().entries:
        if kind in CONTRACTS and kind in Recipe.model_fields:
            own = set(fields(catalog().resolve(kind, name).Config))
            keys |= {f"{kind}.{key}" for key in own} | {f"{kind}.params.{key}" for key in own}
    return keys


SECTION = re.compile(r"([a-z_]+)((?:\.[a-z_0-9]+)+)(?=$|[=:\s,])")
ENDINGS = {"gss", "json", "jsonl", "yaml", "py", "md", "txt", "png", "js", "mjs", "cpp", "hpp", "html"}


def keys_named(text: str) -> Iterator[str]:
    """Keys of recipes in a piece of code: `stream.epochs`, `--set gate.temperature=0.3`."""
    for section, rest in SECTION.findall(text):
        key = section + rest
        if section in Recipe.model_fields and rest.rpartition(".")[2] not in ENDINGS:
            yield key


def methods_named(words: list[str]) -> Iterator[str]:
    yield from (word for before, word in itertools.pairwise(words) if before == "--method")
    if words[:1] == ["compare"] and len(words) > 1:
        yield from filter(None, words[1].split(","))
    if words[:2] == ["methods"]:
        yield from words[2:3]


def check(found: Iterator[str] | list[str]) -> None:
    if wrong := list(found):
        pytest.fail("\n".join(wrong), pytrace=False)


def where(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_the_pages_are_found() -> None:
    assert len(PAGES) > 40
    assert sum(len(list(commands(shell_lines(page)))) for page in PAGES) > 30


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("gsstream rum --source demo", "gsstream has no command 'rum'"),
        ("gsstream run --source demo --out OUT --sauce hot", "gsstream run has no option --sauce"),
        ("gsstream run --source demo", "gsstream run lacks --out"),
        ("gsstream run --source demo --out OUT DIR", "gsstream run takes 0 arguments, not 1"),
        ("gsstream play STREAM --out", "gsstream play --out lacks its value"),
        (
            "X=1 .venv/bin/gsstream methods && gsstream scene sow DIR; ls",
            "gsstream scene has no command 'sow'",
        ),
    ],
)
def test_wrong_calls_are_found(line: str, said: str) -> None:
    assert [found for words in commands([line]) if (found := problem(words, complete=True))] == [said]


def test_wrong_keys_and_methods_are_found() -> None:
    keys = set(keys_named("--set stream.epoch=3 --set stream.epochs=3 runs/stream.gss stream.gss"))
    assert keys - recipe_keys() == {"stream.epoch"}
    assert list(methods_named(["run", "--method", "s3gs"])) == ["s3gs"]


def heading_anchor(heading: str) -> str:
    text = re.sub(r"[^\w\- ]", "", heading.replace("`", "").strip().lower())
    return text.replace(" ", "-")


@pytest.mark.parametrize("page", [*PAGES, *sorted(MADE)], ids=where)
def test_links_lead_somewhere(page: Path) -> None:
    def wrong() -> Iterator[str]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            name, _, anchor = target.partition("#")
            place = (page.parent / name).resolve() if name else page
            if ":" in name:
                continue
            if not place.exists():
                yield target
            elif anchor and place.suffix == ".md":
                headings = re.findall(r"^#+ (.*)$", place.read_text(encoding="utf-8"), re.MULTILINE)
                if anchor not in map(heading_anchor, headings):
                    yield f"{target}: no such heading"

    check(wrong())


def test_no_link_is_dead_in_a_fresh_clone() -> None:
    """Clicks every link from every page to a file: that must be in the repository, not on this disk alone."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a clone: a source archive has all pages")
    tracked = {ROOT / name for name in listed.stdout.split("\0") if name}
    folders = {above for path in tracked for above in path.parents}
    pages, dead, clicked = [path for path in tracked if path.suffix == ".md"], [], 0
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)", FENCE.sub("", page.read_text(encoding="utf-8"))):
            if ":" in target:
                continue
            clicked += 1
            if (page.parent / target).resolve() not in tracked | folders:
                dead.append(f"{where(page)}: {target}")
    check(sorted(dead))
    assert clicked > 300


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_paths_exist(page: Path) -> None:
    def wrong() -> Iterator[str]:
        text = page.read_text(encoding="utf-8")
        for code in INLINE.findall(text):
            for path in re.findall(rf"(?:^|(?<=[\s\"'(=]))(?:{PLACES})/[\w./*{{}},-]*", code):
                pattern = re.sub(r"\{[^}]*\}|(?<![a-z])[A-Z][A-Z_]+(?![a-z.])", "*", path.rstrip(".,"))
                found = any(ROOT.glob(pattern)) or any(page.parent.glob(pattern))
                if not found:
                    yield path
        for module in re.findall(r"python -m ((?:tools|tests|gsstream)(?:\.\w+)*)", text):
            place = ROOT / module.replace(".", "/")
            if not (place.is_dir() or place.with_suffix(".py").is_file() or PLACEHOLDER.fullmatch(place.name)):
                yield module

    check(wrong())


def test_the_layers_of_the_flow_are_those_that_are_proven() -> None:
    page = (ROOT / "docs" / "flow.md").read_text(encoding="utf-8")
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = {contract["containers"][0]: contract["layers"] for contract in contracts if "containers" in contract}
    table = page.split("## Who may import whom\n")[1].split("\n## ")[0]
    rows = [set(INLINE.findall(row.split("|")[1])) for row in table.splitlines() if row.startswith("| `")]
    assert rows == [set(layer.split(" | ")) for layer in layers["gsstream"]]
    (engine,) = re.findall(r"Inside the engine, from top to bottom: ([^.]*)\.", table)
    assert [set(INLINE.findall(layer)) for layer in engine.split(";")] == [
        set(layer.split(" | ")) for layer in layers["gsstream.engine"]
    ]


def test_pages_that_code_and_settings_name_exist() -> None:
    places = ["gsstream/**/*.*", "plugins/*/*.toml", "plugins/*/src/**/*.*", "configs/**/*.yaml", "tools/**/*.*"]
    files = [ROOT / "Makefile", ROOT / "pyproject.toml", *(path for place in places for path in ROOT.glob(place))]
    texts = {path: path.read_text(encoding="utf-8") for path in files if path.suffix in SOURCES}
    assert len(texts) > 400

    def wrong() -> Iterator[str]:
        for path, text in texts.items():
            for name in re.findall(r"(?<![\w/])docs/[\w/-]+(?:\.md)?", text):
                if not any(ROOT.glob(f"{name}*")):
                    yield f"{where(path)}: {name}"

    check(wrong())


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_commands_parse(page: Path) -> None:
    def wrong() -> Iterator[str]:
        for words in commands(shell_lines(page)):
            if said := problem(words, complete=True):
                yield f"{' '.join(words)}: {said}"
        for code in INLINE.findall(prose(page)):
            for words in commands([code]):
                if said := problem(words, complete=False):
                    yield f"`{code}`: {said}"

    check(wrong())


@functools.cache
def options_in_the_code() -> str:
    """Text of everything that defines options: the command line, the tools and scripts, and the settings of pytest."""
    places = [*ROOT.glob("gsstream/cli/**/*.py"), *ROOT.glob("tools/**/*.*"), *ROOT.glob("tests/**/*.py")]
    places += [*ROOT.glob("plugins/*/src/**/*.py"), ROOT / "conftest.py"]
    return "\n".join(path.read_text(encoding="utf-8") for path in places if path.suffix in (".py", ".mjs"))


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_options_in_sentences_exist(page: Path) -> None:
    named = {word for code in INLINE.findall(prose(page)) for word in re.findall(r"(?<![\w-])--[a-z][\w-]+", code)}
    check(sorted(word for word in named - FOREIGN if f'"{word}"' not in options_in_the_code()))


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_recipe_keys_exist(page: Path) -> None:
    blocks = FENCE.findall(page.read_text(encoding="utf-8"))
    pieces = [*INLINE.findall(prose(page)), *shell_lines(page), *(body for kind, body in blocks if kind == "yaml")]
    unknown = {key for piece in pieces for key in keys_named(piece)} - recipe_keys()
    code = "".join(body for kind, body in blocks if kind == "python")
    own = set(re.findall(r"^ +(\w+): ", code, re.MULTILINE))  # settings of a part that the page shows how to write
    check(sorted(key for key in unknown if key.rpartition(".")[2] not in own))


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_methods_exist(page: Path) -> None:
    known = {name for kind, name in catalog().entries if kind == "method"}
    calls = [*commands([*shell_lines(page), *INLINE.findall(prose(page))])]
    named = {name for words in calls for name in methods_named(words)}
    named |= set(re.findall(r"\b(?:encoder_for|encode)\(\"([^\"]+)\"", page.read_text(encoding="utf-8")))
    known |= {
        words[1] for words in calls if words[:1] == ["new-plugin"] and len(words) > 1
    }  # a method that the page shows how to write
    known |= set(re.findall(r"\bMethodSpec\(name=\"([^\"]+)\"", page.read_text(encoding="utf-8")))
    check(sorted(n for n in named - known if not (PLACEHOLDER.fullmatch(n) or n.endswith(".yaml"))))


#: A command in a message ends at a quote, a bracket or a word that goes on with the sentence.
CALL = re.compile(r"gsstream [a-z]+[\w-]*(?: (?:--?[a-z][\w-]*|[A-Z]+\b|X\S*))*")
#: What follows gsstream in sentences about it.
VERBS = {"alone", "and", "based", "does", "file", "is", "of", "package", "reads", "speaks", "that", "to", "writes"}


def messages(path: Path) -> Iterator[str]:
    """Texts in a file of code that are not docstrings; what an f-string puts in stands as X."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (docs | inner):
            yield node.value


def test_commands_that_messages_name_parse() -> None:
    calls = {
        call
        for root in ("gsstream", "plugins")
        for path in ROOT.glob(f"{root}/**/*.py")
        if "tests" not in path.relative_to(ROOT).parts
        for text in messages(path)
        for call in CALL.findall(text)
        if call.split()[1] not in VERBS
    }
    assert len(calls) > 12
    check(sorted(f"{call}: {said}" for call in calls if (said := problem(shlex.split(call)[1:], complete=False))))


#: Groups of entry points and values in examples: neither is a module.
NO_MODULES = {"gsstream.bench", "gsstream.player", "info.world", "source.info.world", "state.player"}
#: Variables of examples that are called like a package.
VARIABLES = {"source", "step"}
DOTTED = re.compile(r"(?<![\w./\"'-])[a-z_]\w*(?:\.[A-Za-z_]\w*)+(?![\w(/:=-])")
COMMENT = re.compile(r"(?:^ *|  )#:? (.*)$", re.MULTILINE)


@functools.cache
def modules() -> dict[str, tuple[set[str], str]]:
    """Dotted name of every module of library, plugins and tools -> names that it binds; its docstrings and comments."""
    roots = [(ROOT, "gsstream"), (ROOT, "tools"), *((path, "") for path in sorted(ROOT.glob("plugins/*/src")))]
    found = {}
    for base, below in roots:
        for path in (base / below).rglob("*.py"):
            name = ".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__")
            text, bound = path.read_text(encoding="utf-8"), set()
            said = COMMENT.findall(text)
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef | ast.ClassDef):
                    bound.add(node.name)
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    bound.add(node.id)
                elif isinstance(node, ast.alias):
                    bound.add(node.asname or node.name)
                elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                    said.append(str(node.value.value))
            found[name] = (bound, "\n".join(said))
    return found


@functools.cache
def ends_of_names() -> dict[str, set[str]]:
    """Every dotted end of the name of a module -> names that such modules bind: "run.session", "session"."""
    ends: dict[str, set[str]] = {}
    for name, (bound, _) in modules().items():
        words = name.split(".")
        for first in range(len(words)):
            ends.setdefault(".".join(words[first:]), set()).update(bound)
    # A package binds its modules.
    for name in modules():
        ends.setdefault(name.partition(".")[0], set()).update(name.split(".")[1:2])
    return ends


def stale(text: str) -> Iterator[str]:
    """Dotted names in a text that look like a module of ours, or something in one, and are neither.

    Looked at is a name that begins with a package, one of modules alone (``residual.joint``), and a constant of a
    module (``init.mapping.LENSES``).
    """
    packages = {name.split(".")[-2] for name in modules() if "." in name} - VARIABLES
    ends = ends_of_names()
    for name in DOTTED.findall(text):
        words = name.split(".")
        constant = len(words) > 2 and words[-2] in ends and words[-1].isupper()
        if not (words[0] in packages or {*words} <= {*ends} or constant) or name in ends or name in NO_MODULES:
            continue
        if words[-1] in ENDINGS or name in recipe_keys():
            continue
        # The name of a module, or of something in a module (or in something in it, such as a method).
        if not any(words[at] in ends.get(".".join(words[:at]), ()) for at in range(1, len(words))):
            yield name


def test_names_of_modules_in_docstrings_and_comments_exist() -> None:
    check([f"{module}: {name}" for module, (_, text) in modules().items() for name in stale(text)])


@pytest.mark.parametrize("name", ["engine.run.threads", "gsstream.x.y", "residual.joint", "init.mapping.LENSES"])
def test_stale_names_are_found(name: str) -> None:
    assert list(stale(f"One torch thread, as in a run: see ``{name}``.")) == [name]


@pytest.mark.parametrize(
    "name", ["engine.run.session", "core.changes.apply_residual", "gsstream.encode", "stream.epochs", "metrics.jsonl"]
)
def test_names_that_exist_are_no_mistakes(name: str) -> None:
    assert list(stale(f"As in {name}.")) == []


#: A phase that is entered in code or named by a call in a page.
PHASE = re.compile(r"\bphase\(f?[\"'](\w+)")


def test_phases_that_pages_and_code_name_are_those_of_a_frame() -> None:
    places = ["gsstream/**/*.py", "plugins/*/src/**/*.py", "tools/**/*.py"]
    files = [*PAGES, *(path for place in places for path in ROOT.glob(place))]
    named = {where(path): set(PHASE.findall(path.read_text(encoding="utf-8"))) for path in files}
    check([f"{path}: {sorted(names - {*PHASES})}" for path, names in named.items() if names - {*PHASES}])
    assert len(set().union(*named.values())) > 5
    table = (ROOT / "docs" / "cost.md").read_text(encoding="utf-8").split("| phase |")[1].split("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)`", table, re.MULTILINE)) <= {*PHASES}
