"""The built-in parts, and the rule for versions."""

from __future__ import annotations

import pydoc
from dataclasses import fields, replace

import pytest

from gsstream.core.errors import PluginUnavailable, UnknownName
from gsstream.core.install_hints import page
from gsstream.core.kinds import CONTRACTS
from gsstream.core.versions import version_problem
from gsstream.discovery.catalog import load_catalog
from gsstream.discovery.discovery import Discovered, PluginFault, discover
from gsstream.spec import CommandSpec, ComponentSpec, MethodSpec


@pytest.fixture
def builtin(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "")
    return load_catalog()


def test_every_built_in_declaration_holds(builtin) -> None:
    for (kind, name), entry in builtin.entries.items():
        if isinstance(entry.spec, MethodSpec):
            assert builtin.recipe_path(name).is_file()
        else:
            target = builtin.resolve(kind, name)
            assert callable(target)
            assert kind == "command" or entry.spec.target.endswith(f":{target.__name__}")
        assert entry.distribution == "gsstream"


def test_every_slot_has_a_built_in_part(builtin) -> None:
    assert {kind for kind in CONTRACTS if builtin.names(kind)} == set(CONTRACTS)
    assert builtin.names("source") == [
        "colmap",
        "demo",
        "enerf",
        "folder",
        "meetroom",
        "n3dv",
        "nerfstudio",
        "panoptic",
        "synthetic",
        "watch",
    ]
    assert not builtin.quarantine


def test_unknown_names_offer_the_nearest(builtin) -> None:
    with pytest.raises(UnknownName) as caught:
        builtin.resolve("gate", "always-opne")
    assert str(caught.value) == "no gate named 'always-opne'; did you mean 'always-open'?"
    with pytest.raises(UnknownName) as caught:
        builtin.recipe_path("quite-different")
    assert str(caught.value) == "no method named 'quite-different'; known: dense, hold"
    with pytest.raises(UnknownName, match="no structure named 'always-open'"):
        builtin.resolve("structure", "always-open")


@pytest.mark.parametrize(
    ("written", "spoken", "advice"),
    [
        ("1.0", "1.0", None),
        ("1.0", "1.4", None),
        ("1.4", "1.4", None),
        ("1.3", "1.1", "built for component API 1.3, this gsstream speaks 1.1: upgrade gsstream"),
        ("1.10", "1.9", "built for component API 1.10, this gsstream speaks 1.9: upgrade gsstream"),
        ("2.0", "1.9", "built for component API 2.0, this gsstream speaks 1.9: upgrade gsstream"),
        (
            "1.9",
            "2.0",
            "built for component API 1.9, this gsstream speaks 2.0: ask its author for a newer version; if you are, "
            f"{page('howto/migrate.md')} says what became of what",
        ),
        ("one", "1.0", "component API version is 'one'; expected 'major.minor', e.g. '1.0'"),
    ],
)
def test_version_rule(written: str, spoken: str, advice: str | None) -> None:
    assert version_problem("component API", written, spoken) == advice


def spec(name: str) -> ComponentSpec:
    return ComponentSpec(kind="gate", name=name, target="gsstream.parts.gate.always_open:AlwaysOpen", summary="a gate")


def test_a_name_declared_twice_quarantines_the_second_plugin_as_a_whole() -> None:
    first = Discovered("a", "gsstream-a", "1", (spec("x"),))
    second = Discovered("b", "gsstream-b", "2", (spec("y"), spec("x")))
    catalog = load_catalog([first, second])
    assert catalog.names("gate") == ["x"]
    (bad,) = catalog.quarantine
    assert bad.reason == "declares the gate 'x', which gsstream-a 1 already provides; rename it"
    with pytest.raises(PluginUnavailable, match="gate 'y' is not available") as caught:
        catalog.resolve("gate", "y")
    assert isinstance(caught.value.__cause__, PluginFault)
    assert catalog.resolve("gate", "x").__name__ == "AlwaysOpen"


def test_the_same_name_in_two_kinds_is_fine() -> None:
    both = (spec("x"), replace(spec("x"), kind="structure"))
    assert not load_catalog([Discovered("a", "gsstream-a", "1", both)]).quarantine


def test_discovery_starts_with_the_built_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "")
    found = discover()
    assert found[0].name == "builtin"
    assert all(plugin.left_out for plugin in found[1:])


@pytest.mark.parametrize("declared", [ComponentSpec, MethodSpec, CommandSpec])
def test_help_on_a_declaration_says_what_its_fields_mean_and_little_else(declared: type) -> None:
    said = pydoc.plain(pydoc.render_doc(declared)).splitlines()
    for field in fields(declared):
        (line,) = [line for line in said if line.strip(" |").startswith(f"{field.name}: ")]
        assert len(line.split(": ", 1)[1]) > 8
        assert said.index(line) < 20
    assert len(said) < 120, "hundreds of lines of the base class would hide them"
