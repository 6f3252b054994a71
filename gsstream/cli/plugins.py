"""``gsstream plugins``: every plugin and part, healthy or quarantined, and the settings of a part."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsstream.cli.listing import plural, table
from gsstream.core.errors import GsstreamError, PluginUnavailable, UnknownName

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog, Entry


def plugins(
    part: Annotated[
        str | None, typer.Argument(help="A part to show: NAME, or KIND/NAME where several parts share a name.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Import every part (slow); report those that fail.")] = False,
) -> None:
    """List all plugins and the parts they ship, or show one part.

    For a part, the settings are shown with their defaults, ranges and meaning, and the methods that set them.
    """
    if part is not None:
        _show(part)
        return
    from gsstream.discovery.catalog import load_catalog
    from gsstream.spec import KINDS

    catalog = load_catalog()
    typer.echo(table(("PLUGIN", "FROM", "STATUS"), _plugin_rows(catalog)))
    order = {kind: place for place, kind in enumerate(KINDS)}
    parts = sorted(catalog.entries.items(), key=lambda item: (order[item[0][0]], item[0][1]))
    rows = [(kind, name, entry.distribution, entry.spec.summary) for (kind, name), entry in parts]
    typer.echo("\n" + table(("KIND", "NAME", "FROM", "SUMMARY"), rows))
    if check and not _check(catalog):
        raise typer.Exit(1)


def _plugin_rows(catalog: Catalog) -> Iterator[tuple[str, str, str]]:
    from gsstream.discovery.discovery import spec_key

    for plugin in catalog.plugins:
        if plugin.specs is None:
            status = f"quarantined: {plugin.reason}"
        elif plugin.left_out:
            status = "left out by GSSTREAM_LOAD_PLUGINS"
        else:
            kinds = [kind if kind in ("method", "command") else "part" for kind, _ in map(spec_key, plugin.specs)]
            status = ", ".join(plural(kinds.count(kind), kind) for kind in ("part", "method", "command"))
        yield plugin.name, f"{plugin.distribution} {plugin.version}", status


def _check(catalog: Catalog) -> bool:
    """Resolve everything; print one line per failure."""
    from gsstream.spec import MethodSpec

    failures = []
    for (kind, name), entry in catalog.entries.items():
        try:
            if isinstance(entry.spec, MethodSpec):
                catalog.recipe_path(name)
            else:
                catalog.resolve(kind, name)
        except PluginUnavailable as error:
            failures.append(str(error))
    typer.echo(f"\n{len(catalog.entries) - len(failures)} of {len(catalog.entries)} declarations hold")
    for failure in failures:
        typer.echo(f"  failed: {failure}")
    return not failures


def _show(part: str) -> None:
    from gsstream.discovery.catalog import load_catalog
    from gsstream.spec import KINDS

    catalog = load_catalog()
    kind, slash, name = part.rpartition("/")
    if slash and kind not in KINDS:
        raise UnknownName("kind of part", kind, KINDS)
    found = [key for key in catalog.entries if key[1] == name and kind in ("", key[0])]
    if not found:
        for plugin in catalog.quarantine:
            if name == plugin.name or any(spec.name == name for spec in plugin.declared):
                raise plugin.unavailable(part) from plugin.error
        raise UnknownName("part", name, {key[1] for key in catalog.entries if kind in ("", key[0])})
    for place, key in enumerate(found):
        typer.echo(("\n" if place else "") + _describe(catalog, *key, catalog.entries[key]))


def _describe(catalog: Catalog, kind: str, name: str, entry: Entry) -> str:
    from gsstream.spec import CommandSpec, MethodSpec

    heading = f"{kind} {name} (from {entry.origin}): {entry.spec.summary}"
    if isinstance(entry.spec, CommandSpec):
        return f"{heading}\nsee: gsstream {name} --help"
    if isinstance(entry.spec, MethodSpec):
        return f"{heading}\nsee: gsstream methods {name}"
    target = catalog.resolve(kind, name)
    lines = [heading, f"target: {entry.spec.target}, component API {entry.spec.api}; defaults: its Config"]
    lines += [f"source: {cited}"] if (cited := getattr(target, "source", None)) else []
    config = getattr(target, "Config", None)
    rows = list(setting_rows(config)) if config is not None else []
    lines += ["", table(("SETTING", "TYPE", "DEFAULT", "MEANING"), rows)] if rows else ["no settings"]
    users = list(_users(catalog, kind, name))
    return "\n".join([*lines, "", table(("METHOD", "SETTING", "VALUE", "SET BY"), users)] if users else lines)


def _users(catalog: Catalog, kind: str, name: str) -> Iterator[tuple[str, str, str, str]]:
    """(method, key, value, who set it) of every method that uses a part; methods that cannot be read are left out."""
    from gsstream.recipe.load import resolve_recipe

    for method in catalog.names("method"):
        try:
            resolved = resolve_recipe(method, catalog.recipe_path)
        except GsstreamError:
            continue  # 'gsstream methods' and 'plugins --check' say what is wrong with it
        ref = getattr(resolved.recipe, kind, None)
        if getattr(ref, "name", None) != name:
            continue
        written = {path: origin for path, origin in resolved.origins.items() if path[:2] == (kind, "params")}
        if not written:
            yield method, "-", "-", "all defaults"
        for path, origin in written.items():
            value = getattr(resolved.recipe, kind).params
            for key in path[2:]:
                value = value[key]
            yield method, ".".join(path[2:]), repr(value), origin.label


def setting_rows(config: type[Any]) -> Iterator[tuple[str, ...]]:
    """Return (key, type with bounds, default, meaning) of every setting; nested ones have dotted keys."""
    from pydantic import TypeAdapter

    yield from _fields(TypeAdapter(config).json_schema(), "")


def _fields(schema: dict[str, Any], prefix: str, root: dict[str, Any] | None = None) -> Iterator[tuple[str, ...]]:
    """One row per setting of a JSON schema; settings that hold settings are followed."""
    root = root or schema
    for name, field in schema.get("properties", {}).items():
        inner = field
        if reference := field.get("$ref"):
            inner = root["$defs"][reference.rpartition("/")[2]]
        if inner.get("properties"):
            defaults = field.get("default") or {}
            for row in _fields(inner, f"{prefix}{name}.", root):
                key = row[0].removeprefix(f"{prefix}{name}.")
                yield (row[0], row[1], repr(defaults[key]) if key in defaults else row[2], row[3])
            continue
        default = repr(field["default"]) if "default" in field else "required"
        yield f"{prefix}{name}", _type(inner), default, field.get("description", "")


_BOUNDS = (("minimum", ">="), ("exclusiveMinimum", ">"), ("maximum", "<="), ("exclusiveMaximum", "<"))


def _type(field: dict[str, Any]) -> str:
    """ "number > 0, <= 1" or "one of a, b"."""
    if "const" in field:
        return repr(field["const"])
    if "anyOf" in field:
        return " or ".join(_type(option) for option in field["anyOf"])
    if "enum" in field:
        return "one of " + ", ".join(str(choice) for choice in field["enum"])
    bounds = ", ".join(f"{sign} {field[key]}" for key, sign in _BOUNDS if key in field)
    return f"{field.get('type', 'any')} {bounds}".rstrip()
