"""Writes the pages of this folder from the code, so that they cannot drift: ``python docs/reference/generate.py``.

``tests/test_architecture.py`` fails while a page on disk differs from what this module makes.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
NOTE = "<!-- Made by docs/reference/generate.py from the code. Do not edit. -->\n"


def exported() -> dict[str, Any]:
    """Every public name of gsstream.api, modules left out."""
    import gsstream.api

    names = {name: value for name, value in vars(gsstream.api).items() if not name.startswith("_")}
    return {name: names[name] for name in sorted(names, key=str.lower) if not inspect.ismodule(names[name])}


def api() -> str:
    """Every exported name: one line in a table, then its exact signature, fields and methods."""
    lines = [NOTE, "# gsstream.api", "", "Everything a plugin or a script may import.", ""]
    lines += ["| name | what it is | defined in |", "|---|---|---|"]
    for name, value in exported().items():
        described = inspect.isclass(value) or inspect.isroutine(value)
        text = (inspect.getdoc(value) or "").splitlines()[0] if described else f"constant, `{value!r}`"
        module = getattr(value, "__module__", "gsstream") if described else "-"
        lines.append(f"| `{name}` | {text.replace('|', chr(92) + '|')} | `{module}` |")
    lines += ["", "## Signatures", ""]
    for name, value in exported().items():
        if inspect.isclass(value) or inspect.isroutine(value):
            lines += [f"### {name}", "", "```python", *_declared(name, value), "```", ""]
    return "\n".join(lines)


def _declared(name: str, value: Any) -> Iterator[str]:
    """A function's signature; of a class how it is made, its fields and its public methods, inherited ones too."""
    if not inspect.isclass(value):
        yield f"def {_signature(name, value)}"
        return
    bases = ", ".join(base.__name__ for base in value.__bases__ if base is not object)
    yield f"class {name}({bases}):" if bases else f"class {name}:"
    for field, kind in _fields(value):
        yield f"    {field}: {kind}"
    made = dataclasses.is_dataclass(value) or "__init__" in vars(value)
    if made and not getattr(value, "_is_protocol", False):
        yield f"    def {_signature('__init__', value.__init__)}"
    for method, member in _members(value):
        function = getattr(member, "fget", None) or getattr(member, "__func__", member)
        if isinstance(member, property | staticmethod | classmethod):
            yield f"    @{type(member).__name__}"
        if getattr(member, "__isabstractmethod__", False):
            yield "    @abstractmethod"
        yield f"    def {_signature(method, function)}"


def _fields(value: type) -> Iterator[tuple[str, str]]:
    """Annotated names of a class that are no constructor arguments told anyway: those of parts, protocols, errors."""
    if dataclasses.is_dataclass(value):
        return
    for field, kind in inspect.get_annotations(value).items():
        if not field.startswith("_"):
            # Named tuples keep annotations as forward references.
            yield field, kind if isinstance(kind, str) else getattr(kind, "__forward_arg__", str(kind))


def _members(value: type) -> Iterator[tuple[str, Any]]:
    """Public functions and properties by name, in the order in which classes declare them, the nearest class first."""
    seen: set[str] = set()
    for cls in value.__mro__:
        if not cls.__module__.startswith("gsstream"):
            continue
        for name, member in vars(cls).items():
            known = isinstance(member, property | staticmethod | classmethod) or inspect.isfunction(member)
            if known and not name.startswith("_") and name not in seen:
                seen.add(name)
                yield name, member


def cli() -> str:
    """Every command with its arguments and options."""
    from typer.main import get_command

    from gsstream.cli.main import app

    lines = [NOTE, "# Command line", ""]
    lines += ["Exit codes: 0 done; 2 something given is wrong; 130 interrupted; 1 other.", ""]
    for path, command in _commands(get_command(app), "gsstream"):
        lines += [f"## {path}", "", (command.help or "").strip(), ""]
        shown = [param for param in command.params if param.name != "help"]
        if shown:
            lines += ["| argument or option | type | default | meaning |", "|---|---|---|---|"]
            for param in shown:
                name = ", ".join(param.opts) if param.param_type_name == "option" else param.name.upper()
                default = getattr(param.default, "value", param.default)
                shown = "required" if param.required else "-" if default in (None, False, ()) else f"`{default}`"
                lines.append(f"| `{name}` | {_option_type(param)} | {shown} | {_cell(getattr(param, 'help', ''))} |")
            lines.append("")
    return "\n".join(lines)


def _option_type(param: Any) -> str:
    annotation = param.type_descriptor.annotation
    if getattr(param, "is_bool_flag", False):
        return "flag"
    if inspect.isclass(annotation) and issubclass(annotation, enum.Enum):
        kind = "one of " + ", ".join(choice.value for choice in annotation)
    else:
        kind = "path" if "Path" in str(annotation) else getattr(annotation, "__name__", str(annotation))
    return kind.replace("list", "str") + (", repeatable" if getattr(param, "multiple", False) else "")


def _commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from _commands(child, f"{path} {name}")


def recipe() -> str:
    """Every key of a recipe with type, default and meaning."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.recipe.model import Recipe

    lines = [NOTE, "# Recipe keys", "", "A part's own settings (`SLOT.params`): `gsstream plugins show PART`.", ""]
    lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += [f"| `{key}` | {kind} | `{default}` | {text} |" for key, kind, default, text in setting_rows(Recipe)]
    return "\n".join(lines) + "\n"


def checks() -> str:
    """Every check of the contract kit, the claim that calls for it, and the saboteur that proves it can fail."""
    from gsstream.testing.kit import all_checks

    folder = str(HERE.parents[1] / "tests" / "contract")
    sys.path.insert(0, folder)
    try:
        saboteur_of = importlib.import_module("saboteurs").saboteur_of
    finally:
        sys.path.remove(folder)

    lines = [NOTE, "# Checks of the contract kit", ""]
    lines += [
        "What every part promises. `gsstream check NAME` makes the checks of a part, a plugin or a method;",
        "`gsstream.testing.parametrize_with_checks` makes one test of each. A check with a claim is made on parts",
        "whose traits claim it, and is otherwise skipped and counted. Each check has a saboteur: a part that is wrong",
        "in one way and fails this check alone (`tests/contract/test_saboteurs.py`).",
        "",
    ]
    kinds = list(dict.fromkeys(entry.kind for entry in all_checks()))
    for kind in kinds:
        lines += [f"## {kind}", "", "| check | meaning | claim | saboteur |", "|---|---|---|---|"]
        for entry in all_checks():
            if entry.kind == kind:
                claim = f"`{entry.trait}`" if entry.trait else "-"
                meaning = entry.meaning.replace("|", chr(92) + "|")
                lines.append(f"| `{entry.name}` | {meaning} | {claim} | {saboteur_of(entry.name)} |")
        lines.append("")
    lines += ["## Not checked here, and why", "", "| property | why not here |", "|---|---|"]
    lines += [f"| {what} | {why} |" for what, why in ELSEWHERE.items()]
    return "\n".join([*lines, ""])


#: What a reader may miss among the checks.
ELSEWHERE = {
    "a structure's time grows with N, not faster": "no check judges by a clock, and shared machines have poor ones",
    "memory returns after an estimate": "`check_confidence_leaves_no_trace` refuses what would hold it, a graph",
    "outputs stay on a GPU": "checks run on the CPU, where every result can be compared bit by bit; a GPU renderer "
    "brings its own suite (`plugins/gsplat_render/tests`)",
    "a gate's noise at the ends of the generator's range": "a generator cannot be made to return them; 65,536 draws "
    "must be finite (`check_gate_noise_is_data`)",
    "no drift over many frames": "minutes, not seconds: `tests/flow/test_closed_loop.py`, and 300 frames in "
    "docs/results-stream.md; the kit compares three frames bit by bit",
    "resume in another process, after a kill": "`tests/flow/test_repeat_and_resume.py`; the kit resumes from the "
    "stream alone, so a process has nothing to add",
    "files cut, torn or lying about themselves": "`tests/packet`; the kit damages packets",
    "quality and size within a stored band": "numbers belong to a machine and a date: docs/results.md",
    "a metric": "metrics are functions, not parts; each is held against an independent implementation in `tests/unit`",
}


def hooks() -> str:
    """Every hook, what it returns, and what a part of each kind has to implement, with exact signatures."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.core.kinds import CONTRACTS
    from gsstream.core.part import Traits
    from gsstream.plugins import hookspecs
    from gsstream.source.base import FrameSource
    from gsstream.spec import KINDS, ComponentSpec, MethodSpec

    lines = [NOTE, "# Hooks, specs and contracts of parts", "", "## Hooks", ""]
    for name, hook in inspect.getmembers(hookspecs, inspect.isfunction):
        if name.startswith("gsstream_"):
            lines += [f"`{_signature(name, hook)}`", "", inspect.getdoc(hook) or "", ""]
    for model in (ComponentSpec, MethodSpec):
        lines += [f"## {model.__name__}", "", (inspect.getdoc(model) or "").splitlines()[0], ""]
        lines += ["| field | type | default | meaning |", "|---|---|---|---|"]
        lines += [f"| `{k}` | {_cell(t)} | `{d}` | {_cell(m)} |" for k, t, d, m in setting_rows(model)]
        lines.append("")
    lines += ["## Kinds", "", f"{', '.join(f'`{kind}`' for kind in KINDS)}.", ""]
    contracts = {kind: _named(target) for kind, target in CONTRACTS.items()} | {"source": FrameSource}
    for kind, contract in contracts.items():
        lines += [f"### {kind}: `{contract.__module__}.{contract.__name__}`", "", inspect.getdoc(contract) or "", ""]
        for name, member in vars(contract).items():
            if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
                function = member.fget if isinstance(member, property) else member
                must = "abstract" if getattr(member, "__isabstractmethod__", False) else "has a default"
                must = "expected" if contract is FrameSource else must
                how = "property " if isinstance(member, property) else ""
                about = (inspect.getdoc(function) or "").splitlines()
                lines.append(f"- {how}`{_signature(name, function)}` ({must}){': ' + about[0] if about else ''}")
        lines.append("")
    rules = inspect.getdoc(importlib.import_module("gsstream.core.auto").SceneFacts) or ""
    signature = "`auto_rules = {SETTING: rule}`, `rule(facts, settings) -> Choice(value, why, ladder=())`"
    lines += ["## Rules of `auto`", "", signature]
    lines += ["([how](../howto/auto.md)). What a rule is told:", "", "```", rules, "```", ""]
    lines += ["## Traits", "", "What a part claims, `traits = GateTraits(...)`; each claim calls for checks.", ""]
    for kind in CONTRACTS:
        record = type(_named(CONTRACTS[kind]).traits)
        if record is not Traits:
            lines += [f"### {record.__name__}", "", "```", inspect.getdoc(record) or "", "```", ""]
    return "\n".join(lines)


def _signature(name: str, function: Any) -> str:
    # Annotations are text already: their quotes say nothing, those of defaults do.
    return name + re.sub(r"(: |-> )([\"'])(.*?)\2", r"\1\3", str(inspect.signature(function)))


def _named(target: str) -> Any:
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def _cell(text: str) -> str:
    return text.replace("|", chr(92) + "|")


def parts() -> str:
    """Every setting of every part of this repository."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.plugins.catalog import load_catalog
    from gsstream.spec import KINDS

    folders = (HERE.parents[1] / "plugins").glob("*/pyproject.toml")
    ours = {"gsstream", *(f"gsstream-{path.parent.name.replace('_', '-')}" for path in folders)}
    catalog = load_catalog()
    lines = [NOTE, "# Settings of every part", ""]
    lines += ["The parts of this repository. Of any part that is installed: `gsstream plugins show KIND/NAME`.", ""]
    for kind in KINDS:
        for name in catalog.names(kind):
            entry = catalog.entry(kind, name)
            config = None
            if entry.distribution in ours and hasattr(entry.spec, "target"):
                config = getattr(catalog.resolve(kind, name), "Config", None)
            if config is None:
                continue
            lines += [f"## {kind} `{name}`", "", f"{entry.spec.summary} (`{entry.distribution}`).", ""]
            rows = list(setting_rows(config))
            lines += ["| setting | type | default | meaning |", "|---|---|---|---|"] if rows else ["No settings.", ""]
            lines += [f"| `{k}` | {_cell(t)} | `{d}` | {_cell(m)} |" for k, t, d, m in rows]
            lines += [""] if rows else []
            if autos := getattr(catalog.resolve(kind, name), "auto_rules", {}):
                keys = ", ".join(f"`{key}`" for key in autos)
                lines += [f"[`auto`](../howto/auto.md), and the scene decides: {keys}.", ""]
    return "\n".join(lines)


def scene_checks() -> str:
    """Every check of ``scene validate``, and what it says about the bad scenes of the tests."""
    import json

    from gsstream.scene.findings import CHECKS

    root = HERE.parents[1]
    sys.path.insert(0, str(root))
    try:
        table = importlib.import_module("tests.scene.bad_scenes")
    finally:
        sys.path.remove(str(root))
    messages = json.loads(table.MESSAGES.read_text(encoding="utf-8"))
    lines = [NOTE, "# Checks of scenes", ""]
    lines += [
        "`gsstream scene validate SCENE` makes these checks in this order and stops at the first stage with an error,",
        "so that one fault gives one message. Below each check: the bad scenes that the tests make of a good one, with",
        "what is said about them.",
        "",
    ]
    for code, meaning in CHECKS.items():
        lines += [f"## {code}", "", f"{meaning[0].upper()}{meaning[1:]}.", "", "| wrong | message |", "|---|---|"]
        rows = [(bad.fault, messages[bad.name]) for bad in table.BAD if bad.code == code]
        lines += [f"| {fault} | {' '.join(said).replace('|', chr(92) + '|')} |" for fault, said in rows]
        lines.append("")
    return "\n".join(lines)


PAGES = {
    "api.md": api, "checks.md": checks, "cli.md": cli, "recipe.md": recipe, "hooks.md": hooks, "parts.md": parts,
    "scene-checks.md": scene_checks,
}  # fmt: skip

if __name__ == "__main__":
    for page, make in PAGES.items():
        (HERE / page).write_text(make(), encoding="utf-8")
