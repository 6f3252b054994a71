"""The catalogue: names -> specs, lazily resolved; plugins that could not be loaded stay visible in quarantine."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsstream.core.errors import STRANGERS, PluginUnavailable, UnknownName
from gsstream.core.install_hints import install_part
from gsstream.core.kinds import PART_KINDS
from gsstream.discovery.discovery import Discovered, PluginFault, Spec, discover, moved, spec_key
from gsstream.spec import CommandSpec, ComponentSpec, MethodSpec


@dataclass(frozen=True, slots=True)
class Entry:
    """A declared part, method or command, and the distribution that ships it."""

    spec: Spec
    plugin: str
    distribution: str
    version: str

    @property
    def origin(self) -> str:
        """ "distribution version", for listings and errors."""
        return f"{self.distribution} {self.version}"


@dataclass(frozen=True, slots=True)
class Catalog:
    """Every part by (kind, name), methods and commands too, and every plugin as it was found, healthy or not."""

    entries: Mapping[tuple[str, str], Entry]
    plugins: tuple[Discovered, ...]

    @property
    def quarantine(self) -> tuple[Discovered, ...]:
        """Plugins that were refused, each with its ``reason``."""
        return tuple(plugin for plugin in self.plugins if plugin.error is not None)

    def names(self, kind: str) -> list[str]:
        """Return the names of all healthy parts of a kind, sorted."""
        return sorted(name for k, name in self.entries if k == kind)

    def entry(self, kind: str, name: str) -> Entry:
        """Look a part up without importing it.

        Raises:
            PluginUnavailable: it exists, but its plugin is in quarantine.
            UnknownName: no plugin declares it; the message offers the nearest name.
        """
        found = self.entries.get((kind, name))
        if found is not None:
            return found
        for plugin in self.quarantine:
            # A plugin that died at import declared nothing: its entry point's name is all that is known of it.
            declared = {spec_key(spec) for spec in plugin.declared}
            if (kind, name) in declared or (not declared and plugin.name == name):
                raise plugin.unavailable(f"{kind} {name!r}") from plugin.error
        broken = len(self.quarantine)
        hint = f" ({broken} plugin{'s'[: broken > 1]} could not be loaded: see 'gsstream plugins')" if broken else ""
        cure = install_part(kind, name)
        if cure is not None and not any(plugin.left_out for plugin in self.plugins):
            hint = f". To install it: {cure}{hint}"
        raise UnknownName(kind, name, self.names(kind), hint)

    def resolve(self, kind: str, name: str) -> Any:
        """Import a part's class and hold it against its kind; of a command, its function or Typer app.

        Raises UnknownName for one that no plugin declares, PluginUnavailable for one that is not what it declares.
        """
        entry = self.entry(kind, name)
        assert not isinstance(entry.spec, MethodSpec), "methods shipped as recipes have no class"
        try:
            return _load_target(entry.spec)
        except STRANGERS as error:  # third-party code: any failure is reported with its owner's name
            reason = str(error) if isinstance(error, PluginFault) else f"{type(error).__name__}: {error}{moved(error)}"
            raise PluginUnavailable(f"{kind} {name!r} (from {entry.origin}) cannot be used: {reason}") from error

    def recipe_path(self, method: str) -> Path:
        """Return the YAML file of a named method.

        Raises:
            PluginUnavailable: quarantined, or the file is not where the declaration says.
            UnknownName: no plugin declares it.
        """
        entry = self.entry("method", method)
        assert isinstance(entry.spec, MethodSpec), "only recipes have the kind method"
        package, _, inside = entry.spec.recipe.partition(":")
        try:
            found = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            found = None
        for folder in (found.submodule_search_locations or []) if found else []:
            if (path := Path(folder, inside)).is_file():
                return path
        raise PluginUnavailable(
            f"method {method!r} (from {entry.origin}) cannot be used: its recipe {entry.spec.recipe!r} does not exist"
        )


def load_catalog(plugins: Iterable[Discovered] | None = None) -> Catalog:
    """Discover plugins (or take ``plugins``) and index their declarations.

    A plugin that declares a name already taken is refused as a whole; the built-in parts come first, then
    distributions in alphabetical order.
    """
    entries: dict[tuple[str, str], Entry] = {}
    kept: list[Discovered] = []
    for plugin in discover() if plugins is None else plugins:
        clash = next((spec for spec in plugin.specs or () if spec_key(spec) in entries), None)
        if clash is not None:
            kind, name = spec_key(clash)
            owner = entries[kind, name].origin
            fault = PluginFault(f"declares the {kind} {name!r}, which {owner} already provides; rename it")
            plugin = replace(plugin, specs=None, error=fault, declared=plugin.specs or ())
        for spec in plugin.specs or ():
            entries[spec_key(spec)] = Entry(spec, plugin.name, plugin.distribution, plugin.version)
        kept.append(plugin)
    return Catalog(entries, tuple(kept))


def _load_target(spec: ComponentSpec | CommandSpec) -> Any:
    module_name, _, attribute = spec.target.partition(":")
    target = getattr(importlib.import_module(module_name), attribute, None)
    if target is None:
        raise PluginFault(f"its target {spec.target!r} does not exist: {module_name} has no {attribute!r}")
    if isinstance(spec, CommandSpec):
        if not callable(target):
            raise PluginFault(f"its target {spec.target!r} is a {type(target).__name__}; expected a function or Typer")
        return target
    kind = PART_KINDS[spec.kind]
    if kind.contract is None:
        if not callable(target):
            raise PluginFault(f"its target {spec.target!r} is a {type(target).__name__}; expected a class")
        return target
    base = kind.contract_class()
    if not (isinstance(target, type) and issubclass(target, base)):
        raise PluginFault(f"its target {spec.target!r} is not a {base.__name__}: declared as {spec.kind!r}")
    if inspect.isabstract(target):
        missing = ", ".join(sorted(getattr(target, "__abstractmethods__", ())))
        raise PluginFault(f"its target {spec.target!r} leaves these methods of {base.__name__} unwritten: {missing}")
    return target
