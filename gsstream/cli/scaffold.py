"""``gsstream new-plugin``: a complete distribution with one working part, ready to be changed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

import gsstream
from gsstream.core.errors import InputError, OutputError, UnknownName
from gsstream.core.install_hints import pip
from gsstream.core.kinds import PART_KINDS

#: Kinds that a plugin can start from.
STARTABLE = tuple(name for name, kind in PART_KINDS.items() if kind.use is not None)
#: Expression of the subject of the contract test: a part, or the recording that a source opens.
SUBJECTS: Mapping[str, str] = {"source": 'SourceUnderTest(<cls>, "<name>:")'}


def new_plugin(
    name: Annotated[str, typer.Argument(help="Name of the part in recipes: lower case letters, digits, - and _.")],
    kind: Annotated[str, typer.Option("--kind", help=f"What the part is: {', '.join(STARTABLE)}.")] = "gate",
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write; by default gsstream-NAME.")] = None,
) -> None:
    """Write a distribution with one working part, its test and README."""
    from gsstream.discovery.catalog import load_catalog

    if not re.fullmatch(r"[a-z][a-z0-9_-]*", name):
        raise InputError(f"plugin name: expected lower case letters, digits, - and _, a letter first; got {name!r}")
    if kind not in STARTABLE:
        raise UnknownName("kind to start from", kind, STARTABLE)
    taken = load_catalog().entries.get((kind, name))
    if taken is not None:
        raise InputError(f"the {kind} {name!r} is already provided by {taken.origin}; choose another name")
    folder = out or Path(f"gsstream-{name}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists and is not an empty folder; choose another --out")
    for path, text in files(name, kind).items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
        typer.echo(f"wrote {target}")
    typer.echo(f"\nnext:\n  {pip()} install -e {folder}\n  gsstream check {kind}/{name}")


def files(name: str, kind: str) -> Mapping[str, str]:
    """Return path -> text of every file of the distribution."""
    package = "gsstream_" + name.replace("-", "_")
    words = "".join(word.capitalize() for word in re.split("[-_]", name) if word)
    suffix = kind.rpartition("_")[2].capitalize()
    cls = words if words.endswith(suffix) else words + suffix
    # The example is one that the contract kit is proven on; it is read as text, so that nothing heavy is imported.
    testing = Path(gsstream.__file__).parent / "testing"
    example = testing / "examples" / f"{kind}.py"
    part = example.read_text(encoding="utf-8").replace(f"Example{suffix}", cls)
    summary = part.splitlines()[0].strip('"')
    values = {"name": name, "kind": kind, "package": package, "cls": cls, "summary": summary, "module": kind}
    values["use"] = _fill(PART_KINDS[kind].use or "", values)
    values["subject"] = _fill(SUBJECTS.get(kind, "<cls>()"), values)
    values["kit"] = ", ".join([*(["SourceUnderTest"] if kind in SUBJECTS else []), "parametrize_with_checks"])
    values["claims"] = CLAIMS.get(kind, CLAIMS[""])
    values["api"] = gsstream.API_VERSION  # stated, so that a later gsstream knows what it was written for
    templates = {**TEMPLATES, **METHOD_TEMPLATES} if kind == "streaming_method" else TEMPLATES
    texts = {path: _fill(text, values) for path, text in templates.items()}
    return {
        **{_fill(path, values): text for path, text in texts.items()},
        f"src/{package}/{kind}.py": part,
    }


def _fill(text: str, values: Mapping[str, str]) -> str:
    return re.sub(r"<(\w+)>", lambda match: values[match[1]], text)


#: Kind -> sentence of the README about its checks.
CLAIMS: Mapping[str, str] = {
    "": "A claim in `traits` is a promise that is checked;\nwhat is not claimed is skipped.",
    "source": "Another recording:\n`gsstream check source/NAME --source NAME:PLACE`.",
}
PLUGIN = "src/<package>/plugin.py"
TEMPLATES: Mapping[str, str] = {
    "pyproject.toml": """\
[build-system]
requires = ["hatchling>=1.27"]
build-backend = "hatchling.build"

[project]
name = "gsstream-<name>"
version = "0.1.0"
description = "<summary>"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["gsstream[encoder]"]

[project.optional-dependencies]
test = ["pytest"]

[project.entry-points.gsstream]
<name> = "<package>.plugin"

[tool.hatch.build.targets.wheel]
packages = ["src/<package>"]
""",
    "README.md": """\
# gsstream-<name>

<summary>

One part for gsstream: the <kind> `<name>`.

```
pip install -e .
gsstream check <kind>/<name>
gsstream plugins <kind>/<name>
gsstream run --method dense <use> --out run/
```

The part is in `src/<package>/<module>.py`. Change it, its docstring and its `source`, and check again:
`gsstream check <kind>/<name>`, or `pytest` for one test per check. <claims>
""",
    "src/<package>/__init__.py": '"""<summary> Importing this package imports no torch."""\n',
    PLUGIN: '''\
"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        ComponentSpec(
            kind="<kind>",
            name="<name>",
            target="<package>.<module>:<cls>",
            summary="<summary>",
            api="<api>",
        )
    ]
''',
    "tests/test_<package>_contract.py": '''\
"""The part keeps the contract."""

from <package>.<module> import <cls>

from gsstream.testing import <kit>


@parametrize_with_checks([<subject>])
def test_contract(check) -> None:
    check()
''',
}
#: A streaming_method is a whole method: it is shipped with a recipe, so that ``--method`` finds it.
METHOD_TEMPLATES: Mapping[str, str] = {
    "README.md": """\
# gsstream-<name>

<summary>

One method for gsstream: `<name>`, as the streaming_method of that name and a recipe that takes it.

```
pip install -e .
gsstream check <kind>/<name>
gsstream check method/<name>
gsstream run --method <name> --source demo --out run/
```

The method is in `src/<package>/<module>.py`, its recipe in `src/<package>/recipes/<name>.yaml`; more recipes make more
methods of the same code, each with a `MethodSpec` in `plugin.py`. Change them, and check again: with `gsstream check`,
or with `pytest` for one test per check. <claims>
""",
    "src/<package>/recipes/<name>.yaml": """\
# The method as --method <name> finds it: what is not said here has its default (gsstream recipe <name>).
method: <name>
streaming_method: {name: <name>}
""",
    PLUGIN: TEMPLATES[PLUGIN].replace("ComponentSpec,", "ComponentSpec, MethodSpec,")
    + """

@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    return [MethodSpec(name="<name>", recipe="<package>:recipes/<name>.yaml", summary="<summary>")]
""",
    "tests/test_<package>_method.py": '''\
"""The method keeps the contract of whole methods."""

from gsstream.testing.kit import run_method_checks


def test_as_a_method() -> None:
    assert [result for result in run_method_checks("<name>") if not result.ok] == []
''',
}
