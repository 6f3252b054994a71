"""A broken plugin never costs more than itself: it is listed with its reason, everything else works."""

from __future__ import annotations

import re

import pytest

from gsstream.core.install_hints import page

MIGRATE = page("howto/migrate.md")
REASONS = {
    "raises_at_import": "ModuleNotFoundError: No module named 'a_package_nobody_has'",
    "exits_at_import": "SystemExit: no licence found",
    "unspeakable": "Unspeakable: its message cannot be read: RuntimeError",
    "other_major": "from-the-future: built for component API 4.0, this gsstream speaks 3.0: upgrade gsstream",
    "newer_minor": "newer-gate: built for component API 3.3, this gsstream speaks 3.0: upgrade gsstream",
    "older_major": "from-the-past: built for component API 1.0, this gsstream speaks 3.0: ask its author for a "
    f"newer version; if you are, {MIGRATE} says what became of what",
    "renamed_kind": "hicom: built for component API 1.0, this gsstream speaks 3.0: ask its author for a "
    f"newer version; if you are, {MIGRATE} says what became of what",
    "old_name": "ImportError: cannot import name 'GateState' from 'gsstream.api' ",
    "duplicate_name": "declares the gate 'always-open', which gsstream 0.1.0 already provides; rename it",
    "unknown_hook": "implements the hook 'gsstream_component', which this gsstream does not know; did you mean "
    "'gsstream_components'?",
    "wrong_arguments": "PluginValidationError: Plugin 'gsstream_wrong_arguments_plugin' for hook 'gsstream_components' "
    "hookimpl definition: gsstream_components(registry) Argument(s) {'registry'} are declared in the hookimpl but ",
    "wrong_return": "gsstream_components() returned a str in its list; expected ComponentSpec",
    "bad_spec": "ComponentSpec of component API 3.0: kind: Input should be 'structure', 'confidence', "
    "'propagation', 'gate', 'motion', 'update', 'growth', 'regularizer', 'streaming_method', 'renderer' "
    f"or 'source', got 'gatte'; of older kinds: {MIGRATE}",
    "command_clash": "declares the command 'run', which gsstream 0.1.0 already provides; rename it",
    "closes_stdout": "it closed stdout while it was loaded; what it closed is open again",
    "closes_numbers": "it closed stdout and stderr while it was loaded; what it closed is open again",
    "no_hook": "gsstream_no_hook_plugin implements no hook; expected @hookimpl on one of gsstream_components, ",
}


def test_each_is_listed_with_its_reason_while_the_rest_works(lab) -> None:
    """All of them at once."""
    for fault in REASONS:
        lab.install(fault)
    listing, methods = lab.cli("plugins"), lab.cli("methods")
    assert (listing.returncode, methods.returncode) == (0, 0), listing.stderr + methods.stderr
    for fault, reason in REASONS.items():
        (line,) = [line for line in listing.stdout.splitlines() if line.startswith(f"{fault} ")]
        assert f"gsstream-{fault.replace('_', '-')} 0.3" in line
        assert f"quarantined: {reason}" in line
        assert reason in methods.stderr
    assert listing.stdout.count("quarantined: ") == len(REASONS)
    (old,) = [line for line in listing.stdout.splitlines() if line.startswith("old_name ")]
    assert old.endswith(f"; if it was written for an older interface: {MIGRATE}")
    assert "always-open" in listing.stdout
    assert methods.stdout.splitlines()[1].startswith("dense")
    assert lab.cli("recipe", "dense").returncode == 0


@pytest.mark.parametrize(
    ("fault", "asked", "cause"),
    [
        ("raises_at_import", "raises_at_import", "ModuleNotFoundError"),
        ("newer_minor", "newer-gate", "PluginFault"),
        ("duplicate_name", "free-name", "PluginFault"),
    ],
)
def test_asking_for_a_quarantined_part_raises_from_the_original_error(lab, fault: str, asked: str, cause: str) -> None:
    lab.install(fault)
    code = (
        "import sys\n"
        "from gsstream.discovery.catalog import load_catalog\n"
        "from gsstream.core.errors import PluginUnavailable\n"
        "try: load_catalog().resolve('gate', sys.argv[1])\n"
        "except PluginUnavailable as error: print(type(error.__cause__).__name__, error)\n"
    )
    result = lab.python(code, asked)
    assert result.stdout.startswith(f"{cause} gate {asked!r} is not available: plugin {fault!r} (from gsstream-")
    assert REASONS[fault] in result.stdout
    shown = lab.cli("plugins", asked)
    assert shown.returncode == 1
    assert REASONS[fault] in shown.stderr


def test_lying_declarations_are_found_when_used(lab) -> None:
    lab.install("lying_spec")
    assert lab.cli("plugins").returncode == 0
    check = lab.cli("plugins", "--check")
    assert check.returncode == 1
    for name, reason in {
        "gate 'no-module'": "ModuleNotFoundError: No module named 'a_module_nobody_has'",
        "gate 'no-class'": "its target 'gsstream.parts.gate.always_open:Gate' does not exist: gsstream.parts.gate",
        "gate 'wrong-kind'": "its target 'gsstream.parts.structure.flat:Flat' is not a GateSampler: declared as 'gate'",
        "gate 'not-a-class'": "its target 'gsstream.parts.gate.base:__doc__' is not a GateSampler: declared as 'gate'",
        "gate 'unfinished'": "leaves these methods of GateSampler unwritten: ",
        "method 'no-recipe'": "its recipe 'gsstream.recipe:methods/absent.yaml' does not exist",
    }.items():
        (line,) = [line for line in check.stdout.splitlines() if line.startswith(f"  failed: {name} ")]
        assert "(from gsstream-lying-spec 0.3)" in line
        assert reason in line


def test_an_entry_point_to_nowhere(lab) -> None:
    lab.install("unknown_hook", entry_points="[gsstream]\nunknown_hook = gsstream_absent_module\n")
    lab.add("healthy", HEALTHY)
    listing = lab.cli("plugins").stdout
    assert "quarantined: ModuleNotFoundError: No module named 'gsstream_absent_module'" in listing
    assert "1 part, 0 methods" in listing


HEALTHY = """
from gsstream.spec import ComponentSpec, hookimpl

@hookimpl
def gsstream_components():
    target = "gsstream.parts.gate.always_open:AlwaysOpen"
    return [ComponentSpec(kind="gate", name="mine", target=target, summary="mine")]
"""


def test_the_second_owner_of_a_name_is_refused_whatever_the_order_on_the_path(lab) -> None:
    lab.add("zeta", HEALTHY)
    lab.add("alpha", HEALTHY)
    listing = lab.cli("plugins").stdout
    assert "quarantined: declares the gate 'mine', which gsstream-alpha 0.3 already provides; rename it" in listing
    assert listing.count("quarantined") == 1


def test_allow_list(lab) -> None:
    lab.add("healthy", HEALTHY)
    lab.install("raises_at_import")
    only = lab.cli("plugins", load="healthy,helthy").stdout
    assert "1 part, 0 methods" in only
    assert re.search(r"raises-at-import 0\.3 +left out by GSSTREAM_LOAD_PLUGINS\n", only)
    assert "quarantined: named in GSSTREAM_LOAD_PLUGINS but not installed; did you mean 'healthy'?" in only
    nothing = lab.cli("plugins", load="").stdout
    assert "mine" not in nothing
    assert "a_package_nobody_has" not in nothing


def test_trace_prints_every_hook_call(lab) -> None:
    lab.add("healthy", HEALTHY)
    traced = lab.cli("methods", GSSTREAM_TRACE_PLUGINS="1").stderr
    assert "gsstream: gsstream_healthy_plugin: gsstream_components() -> [[ComponentSpec(" in traced
    assert "trace" not in lab.cli("methods").stderr


def test_unknown_names_mention_quarantine(lab) -> None:
    lab.install("raises_at_import")
    result = lab.cli("methods", "s2gz")
    assert result.returncode == 2
    assert result.stderr == (
        "error: no method named 's2gz'; known: dense, hold (1 plugin could not be loaded: see 'gsstream plugins')\n"
    )


def test_a_command_in_quarantine_says_why_and_costs_no_other(lab) -> None:
    lab.install("command_clash")
    shown = lab.cli("--help")
    assert shown.returncode == 0
    assert " mine " not in shown.stdout
    asked = lab.cli("mine")
    assert (asked.returncode, asked.stdout) == (1, "")
    assert asked.stderr.startswith("error: the command 'mine' is not available: plugin 'command_clash'")
    assert "already provides; rename it" in asked.stderr
    assert lab.cli("run", "--help").returncode == 0, "gsstream's own keeps its name"


def test_a_command_whose_target_is_broken_is_listed_and_fails_alone(lab) -> None:
    lab.install("command_targets")
    shown = lab.cli("--help")
    assert shown.returncode == 0
    assert "Mine:\n" in shown.stdout
    assert "Nothing to import." in shown.stdout, "the listing imports no target"
    done = lab.cli("works", "--count", "3")
    assert (done.returncode, done.stdout) == (0, "3\n")
    for name, reason in (("absent", "No module named 'a_package_nobody_has'"), ("odd", "doesn't support Union types")):
        asked = lab.cli(name)
        assert asked.returncode == 1
        assert asked.stderr.startswith(f"error: command {name!r} (from gsstream-command-targets 0.3) cannot be used: ")
        assert reason in asked.stderr
        assert asked.stderr.count("\n") == 1
    failed = lab.cli("plugins", "--check")
    assert failed.returncode == 1
    assert "failed: command 'absent'" in failed.stdout
    typo = lab.cli("work")
    assert typo.returncode == 2
    assert "Did you mean 'works'" in typo.stderr
    passed = lab.cli("check", "command/works")
    assert passed.returncode == 1
    assert "these options have no help: works count" in passed.stdout
