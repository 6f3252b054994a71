"""Guarded discovery: every entry point in its own ``try``; a failure becomes a record, never a dead program.

pluggy checks and calls the hooks, but does not find plugins for us: its own loader stops at the first that fails.

Environment:
    GSSTREAM_LOAD_PLUGINS: comma-separated allow-list of entry points or distributions; empty loads none.
    GSSTREAM_TRACE_PLUGINS: 1 prints every hook call and what it returned to stderr.
"""

from __future__ import annotations

import importlib.metadata
import os
import sys
import textwrap
import threading
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import pluggy
import pydantic

from gsstream import API_VERSION, __version__
from gsstream.core.errors import STRANGERS, PluginUnavailable, suggest
from gsstream.core.install_hints import page
from gsstream.core.versions import MIGRATE, version_problem
from gsstream.discovery import builtin, hookspecs
from gsstream.discovery.outputs import kept_outputs
from gsstream.spec import ENTRY_POINT_GROUP, CommandSpec, ComponentSpec, MethodSpec

Spec = ComponentSpec | MethodSpec | CommandSpec
HOOKS: dict[str, type[Spec]] = {
    "gsstream_components": ComponentSpec,
    "gsstream_methods": MethodSpec,
    "gsstream_commands": CommandSpec,
}

#: Seconds after which a plugin that is still being imported is named.
SLOW = 5.0


class PluginFault(Exception):
    """Why a plugin is refused; never leaves this package except as the cause of ``PluginUnavailable``."""


@dataclass(frozen=True, slots=True)
class Discovered:
    """One plugin: healthy, left out, or in quarantine; exactly one of ``specs`` and ``error`` is given."""

    name: str  # name of the entry point
    #: distribution, version: the installed distribution that ships it; "?" when its metadata is unreadable.
    distribution: str
    version: str
    specs: tuple[Spec, ...] | None  # what it declares, in its order
    error: BaseException | None = None  # why it is in quarantine
    declared: tuple[Spec, ...] = ()  # what a quarantined plugin did declare before it was refused, if it came that far
    left_out: bool = False  # not loaded, because GSSTREAM_LOAD_PLUGINS does not name it; ``specs`` is empty

    @property
    def reason(self) -> str:
        """Return the error in one line, with its type unless the message names the fault by itself."""
        if self.error is None:
            return ""
        text = textwrap.shorten(_message(self.error) or "no message", 400, placeholder=" ...")
        own = isinstance(self.error, PluginFault | pydantic.ValidationError)
        return text if own else f"{type(self.error).__name__}: {text}"

    def unavailable(self, what: str) -> PluginUnavailable:
        """Return the error for a request of a part of this quarantined plugin; raise it from ``error``."""
        return PluginUnavailable(
            f"{what} is not available: plugin {self.name!r} (from {self.distribution} {self.version}) is in "
            f"quarantine: {self.reason}"
        )


def discover() -> list[Discovered]:
    """Find the built-in parts, then every installed plugin, by distribution and entry point. Never raises."""
    found = [_inspect("builtin", "gsstream", __version__, lambda: builtin)]
    allowed = _allow_list()
    seen: set[str] = set()
    for point, distribution, version in _entry_points():
        seen |= {point.name, distribution}
        if allowed is not None and not allowed & {point.name, distribution}:
            found.append(Discovered(point.name, distribution, version, (), left_out=True))
        else:
            found.append(_inspect(point.name, distribution, version, point.load))
    for name in sorted((allowed or set()) - seen):
        missing = PluginFault(f"named in GSSTREAM_LOAD_PLUGINS but not installed{suggest(name, seen)}")
        found.append(Discovered(name=name, distribution="?", version="?", specs=None, error=missing))
    return found


def _allow_list() -> set[str] | None:
    text = os.environ.get("GSSTREAM_LOAD_PLUGINS")
    return None if text is None else {name.strip() for name in text.split(",") if name.strip()}


def _entry_points() -> list[tuple[importlib.metadata.EntryPoint, str, str]]:
    """(entry point, distribution, version) of our group, in an order that does not depend on the path."""
    found = []
    for point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        assert point.dist is not None, "entry points that were discovered know their distribution"
        metadata = point.dist.metadata
        found.append((point, metadata["Name"] or "?", metadata["Version"] or "?"))
    return sorted(found, key=lambda item: (item[1], item[0].name))


def _inspect(name: str, distribution: str, version: str, load: Any) -> Discovered:
    declared: list[Spec] = []
    late = threading.Timer(SLOW, _warn_slow, (name, distribution))
    late.daemon = True
    late.start()
    try:
        with kept_outputs() as closed:
            module = load()
            _collect(module, declared)
        if closed:
            raise PluginFault(f"it closed {' and '.join(closed)} while it was loaded; what it closed is open again")
    except KeyboardInterrupt:
        raise  # Ctrl-C: a plugin that raises KeyboardInterrupt cannot be told from a user who presses it
    except BaseException as error:  # containing whatever a plugin raises is the purpose of this function
        return Discovered(
            name=name, distribution=distribution, version=version, specs=None, error=error, declared=tuple(declared)
        )
    finally:
        late.cancel()
    return Discovered(name, distribution, version, tuple(declared))


def _warn_slow(name: str, distribution: str) -> None:
    """Print the name of a plugin whose import takes long: a plugin that hangs stops the whole program."""
    print(
        f"gsstream: the plugin {name!r} (from {distribution}) has been loading for {SLOW:g} seconds; "
        "GSSTREAM_LOAD_PLUGINS=OTHER,NAMES leaves it out",
        file=sys.stderr,
        flush=True,
    )


def _message(error: BaseException) -> str:
    """Return the text of an error in printable characters; the ``__str__`` of a plugin's error may raise, too."""
    if isinstance(error, pydantic.ValidationError):
        return _refusal(error)
    try:
        return str(error).encode("utf-8", "backslashreplace").decode() + moved(error)
    except STRANGERS as failure:
        return f"its message cannot be read: {type(failure).__name__}"


def _refusal(error: pydantic.ValidationError) -> str:
    """Return what is wrong with a declaration: its version, where that is the reason, else each of its fields."""
    wrong = error.errors()
    version = [str(w["ctx"]["error"]) for w in wrong if w["type"] == "value_error" and not w["loc"]]
    if version:
        return version[0]
    said = "; ".join(f"{'.'.join(map(str, w['loc']))}: {w['msg']}, got {w['input']!r}" for w in wrong)
    older = f"; of older kinds: {page(MIGRATE)}" if any(w["loc"] == ("kind",) for w in wrong) else ""
    return f"{error.title} of component API {API_VERSION}: {said}{older}"


def moved(error: BaseException) -> str:
    """Name the page of what became of what, after an error about a name that gsstream does not have; else nothing."""
    ours = isinstance(error, ImportError) and (error.name or "").partition(".")[0] == "gsstream"
    return f"; if it was written for an older interface: {page(MIGRATE)}" if ours else ""


def _collect(module: ModuleType, declared: list[Spec]) -> None:
    """Call the hooks of one plugin, append what it declares, raise PluginFault at the first thing refused."""
    manager = pluggy.PluginManager("gsstream")
    manager.add_hookspecs(hookspecs)
    if os.environ.get("GSSTREAM_TRACE_PLUGINS") == "1":
        _trace(manager, module.__name__)
    manager.register(module)
    callers = manager.get_hookcallers(module) or []
    for hook, model in HOOKS.items():
        for result in getattr(manager.hook, hook)():
            _check_result(hook, model, result)
            declared.extend(result)
    _check_versions(declared)
    unknown = sorted(caller.name for caller in callers if not caller.has_spec())
    if unknown:
        hint = suggest(unknown[0], HOOKS)
        raise PluginFault(f"implements the hook {unknown[0]!r}, which this gsstream does not know{hint}")
    if not callers:
        raise PluginFault(f"{module.__name__} implements no hook; expected @hookimpl on one of {', '.join(HOOKS)}")
    _check_unique(declared)


def _trace(manager: pluggy.PluginManager, module: str) -> None:
    def after(outcome: Any, hook: str, _impls: Any, _kwargs: Any) -> None:
        result = outcome.exception or outcome.get_result()
        print(f"gsstream: {module}: {hook}() -> {result!r}", file=sys.stderr)

    manager.add_hookcall_monitoring(lambda *_: None, after)


def _check_result(hook: str, model: type[Spec], result: object) -> None:
    if not isinstance(result, list | tuple):
        raise PluginFault(f"{hook}() returned {type(result).__name__}; expected a list of {model.__name__}")
    for item in result:
        if not isinstance(item, model):
            raise PluginFault(f"{hook}() returned a {type(item).__name__} in its list; expected {model.__name__}")


def _check_versions(declared: list[Spec]) -> None:
    for spec in declared:
        problem = version_problem("component API", spec.api, API_VERSION)
        if problem:
            raise PluginFault(f"{spec.name}: {problem}")


def _check_unique(declared: list[Spec]) -> None:
    keys = [spec_key(spec) for spec in declared]
    for kind, name in keys:
        if keys.count((kind, name)) > 1:
            raise PluginFault(f"declares the {kind} {name!r} twice")


def spec_key(spec: Spec) -> tuple[str, str]:
    """Return (kind, name); named methods have the kind "method", commands "command"."""
    if isinstance(spec, ComponentSpec):
        return spec.kind, spec.name
    return "method" if isinstance(spec, MethodSpec) else "command", spec.name
