"""The pages of hooks, of contracts and their checks, and of the settings of every part."""

from __future__ import annotations

import importlib
import inspect
import sys
from typing import Any

from tools.reference.text import NOTE, ROOT, cell, signature


def checks() -> str:
    """Every check of the contract kit, the claim that calls for it, and the saboteur that proves it can fail."""
    from gsstream.testing.kit import all_checks

    folder = str(ROOT / "tests" / "contract")
    sys.path.insert(0, folder)
    try:
        saboteur_of = importlib.import_module("saboteurs").saboteur_of
    finally:
        sys.path.remove(folder)

    lines = [NOTE, "# Checks of the contract kit", ""]
    lines += [
        "What every part promises. `gsstream check NAME` makes the checks of a part, a plugin or a method;",
        "`gsstream.testing.parametrize_with_checks` makes one test of each. A check with a claim is made on parts",
        "whose traits claim it; of others `gsstream check` says that it is skipped, and no test is made of it.",
        "Each check has a saboteur: a part that is wrong in one way and fails this check alone",
        "(`tests/contract/test_saboteurs.py`).",
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


#: Promise for which a reader may look for a check -> why there is none.
ELSEWHERE = {
    "a structure's time grows with N, not faster": "no check decides by a clock, and shared machines have poor ones",
    "memory returns after an estimate": "`check_confidence_no_grad_left` refuses what would hold it, a graph",
    "outputs stay on a GPU": "checks run on the CPU, where every result can be compared bit by bit; a GPU renderer "
    "brings its own suite (`plugins/gsplat_render/tests`)",
    "a gate's noise at the ends of the generator's range": "a generator cannot be made to return them; 65,536 draws "
    "must be finite (`check_gate_noise_is_data`)",
    "no drift over many frames": "minutes, not seconds: `tests/flow/test_closed_loop.py`, and 300 frames in "
    "docs/results/trade.md; the kit compares three frames bit by bit",
    "resume in another process, after a kill": "`tests/flow/test_repeat_and_resume.py`; the kit resumes from the "
    "stream alone, so a process has nothing to add",
    "files cut, torn or lying about themselves": "`tests/packet`; the kit damages packets",
    "quality and size within a stored band": "numbers belong to a machine and a date: docs/results/index.md",
    "a metric": "metrics are functions, not parts; each is held against an independent implementation in "
    "`tests/metrics`",
}


def hooks() -> str:
    """Every hook, what it returns, and what a part of each kind has to implement, with exact signatures."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.core.kinds import CONTRACTS, PART_KINDS
    from gsstream.core.part import Traits
    from gsstream.discovery import hookspecs
    from gsstream.input.recordings.base import Source
    from gsstream.spec import KINDS, ComponentSpec, MethodSpec

    lines = [NOTE, "# Hooks, specs and contracts of parts", "", "## Hooks", ""]
    for name, hook in inspect.getmembers(hookspecs, inspect.isfunction):
        if name.startswith("gsstream_"):
            lines += [f"`{signature(name, hook)}`", "", inspect.getdoc(hook) or "", ""]
    for model in (ComponentSpec, MethodSpec):
        lines += [f"## {model.__name__}", "", (inspect.getdoc(model) or "").splitlines()[0], ""]
        lines += ["| field | type | default | meaning |", "|---|---|---|---|"]
        lines += [f"| `{k}` | {cell(t)} | `{d}` | {cell(m)} |" for k, t, d, m in setting_rows(model)]
        lines.append("")
    lines += ["## Kinds", "", f"{', '.join(f'`{kind}`' for kind in KINDS)}.", ""]
    contracts = {kind: _named(target) for kind, target in CONTRACTS.items()} | {"source": Source}
    for kind, contract in contracts.items():
        lines += [f"### {kind}: `{contract.__module__}.{contract.__name__}`", "", inspect.getdoc(contract) or "", ""]
        for name, member in vars(contract).items():
            if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
                function = member.fget if isinstance(member, property) else member
                must = "abstract" if getattr(member, "__isabstractmethod__", False) else "has a default"
                must = "final" if getattr(member, "__final__", False) else must
                how = "property " if isinstance(member, property) else ""
                about = (inspect.getdoc(function) or "").splitlines()
                lines.append(f"- {how}`{signature(name, function)}` ({must}){': ' + about[0] if about else ''}")
        lines.append("")
    lines += ["## Traits", "", "What a part claims, `traits = GateTraits(...)`; each claim calls for checks.", ""]
    for part_kind in PART_KINDS.values():
        record = Traits if part_kind.contract is None else type(part_kind.contract_class().traits)
        if record is not Traits:
            lines += [f"### {record.__name__}", "", "```", inspect.getdoc(record) or "", "```", ""]
    return "\n".join(lines)


def _named(target: str) -> Any:
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def parts() -> str:
    """Every setting of every part of this repository."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.discovery.catalog import load_catalog
    from gsstream.spec import KINDS

    folders = (ROOT / "plugins").glob("*/pyproject.toml")
    ours = {"gsstream", *(f"gsstream-{path.parent.name.replace('_', '-')}" for path in folders)}
    catalog = load_catalog()
    lines = [NOTE, "# Settings of every part", ""]
    lines += ["The parts of this repository. Of any part that is installed: `gsstream plugins KIND/NAME`.", ""]
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
            lines += [f"| `{k}` | {cell(t)} | `{d}` | {cell(m)} |" for k, t, d, m in rows]
            lines += [""] if rows else []
    return "\n".join(lines)
