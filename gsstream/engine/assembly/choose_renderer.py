"""The renderer of a recipe that leaves the choice open: a GPU's where one works, else the fastest of the processor."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from gsstream.core.errors import STRANGERS, InputError, PluginUnavailable, UnknownName
from gsstream.core.install_hints import install_extra, install_renderer
from gsstream.core.part import Part
from gsstream.discovery.catalog import Catalog

VARIABLE = "GSSTREAM_DEVICE"
#: Renderers that are tried, in this order, before the reference is taken.
ON_GPU, COMPILED = "gsplat", "cpu"


class SlowRendererWarning(UserWarning):
    """The reference renderer is used because no fast one works here."""


class Chosen(NamedTuple):
    """A renderer by name, and the sentence on the GPU that is used, or why it is not; empty where there is none."""

    name: str
    renderer: Part
    note: str


def requested_device(environment: Mapping[str, str] = os.environ) -> str:
    """Return the device named in the environment: auto, cpu, cuda or cuda:N. Raises InputError for any other value."""
    text = environment.get(VARIABLE, "") or "auto"
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", text):
        raise InputError(f"{VARIABLE}: expected auto, cpu, cuda or cuda:N, got {text!r}")
    return text


def choose_renderer(catalog: Catalog, processor_only: str = "") -> Chosen:
    """Return the fastest renderer that works here; ``processor_only``: why the parts cannot use a GPU, or empty.

    Raises InputError for a GSSTREAM_DEVICE that it cannot have, PluginUnavailable where it asks for a GPU in vain.
    """
    device, note = requested_device(), ""
    if device != "cpu":
        found = _on_gpu(catalog, device, processor_only)
        if isinstance(found, Chosen):
            return found
        if device != "auto":
            raise PluginUnavailable(f"{VARIABLE}={device}: {found or 'there is no NVIDIA GPU that torch can use'}")
        note = found
    renderer = _tried(catalog, COMPILED, f"no renderer named {COMPILED!r}")
    if isinstance(renderer, Part):
        return Chosen(COMPILED, renderer, note)
    _warn_slow(catalog, renderer)
    cls = catalog.resolve("renderer", "reference")
    return Chosen("reference", construct("renderer", "reference", cls, config=cls.Config(), catalog=catalog), note)


def _on_gpu(catalog: Catalog, device: str, processor_only: str) -> Chosen | str:
    """The renderer on the GPU, or why it is not used; empty where there is no GPU."""
    if not torch.cuda.is_available():
        if not (Path("/proc/driver/nvidia/version").is_file() or shutil.which("nvidia-smi")):
            return ""
        build = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "for the processor only"
        return f"the NVIDIA GPU is not used: torch {torch.__version__} is built {build}; {install_extra('gpu')}"
    gpu = torch.cuda.get_device_name(None if device == "auto" else device)
    if processor_only:
        return f"{gpu} is not used: {processor_only}"
    settings = {} if device == "auto" else {"device": device}
    renderer = _tried(catalog, ON_GPU, install_extra("gpu"), **settings)
    if isinstance(renderer, Part):
        return Chosen(ON_GPU, renderer, f"rendering on {gpu} with {ON_GPU} {_version(ON_GPU)}".rstrip())
    return f"{gpu} is not used: {renderer}"


def _tried(catalog: Catalog, name: str, absent: str, **settings: str) -> Part | str:
    """The renderer, or why it does not work here; ``absent`` where no plugin declares it."""
    try:
        cls = catalog.resolve("renderer", name)
        return construct("renderer", name, cls, config=cls.Config(**settings), catalog=catalog)
    except UnknownName:
        return absent
    except PluginUnavailable as error:
        return str(error)


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _warn_slow(catalog: Catalog, reason: str) -> None:
    left_out = any(plugin.left_out and plugin.distribution == "gsstream-cpu-render" for plugin in catalog.plugins)
    cure = "let GSSTREAM_LOAD_PLUGINS name gsstream-cpu-render" if left_out else install_renderer()
    warnings.warn(
        "no fast renderer works here, so the reference renderer is used: about 500 times slower. To mend it, "
        f"{cure}. Reason: {reason}",
        SlowRendererWarning,
        stacklevel=4,
    )


def construct(slot: str, name: str, cls: type[Any], config: Any, catalog: Catalog) -> Part:
    """Build a part. Raises PluginUnavailable, or InputError for a setting of the user's, in its owner's name."""
    try:
        part: Part = cls(config)
    except InputError as error:  # a setting of the user's, such as an environment variable: no other part mends it
        origin = catalog.entry(slot, name).origin
        raise InputError(f"{slot} {name!r} (from {origin}) could not be built: {error}") from error
    except STRANGERS as error:  # third-party constructor: reported with its owner's name
        origin = catalog.entry(slot, name).origin
        raise PluginUnavailable(f"{slot} {name!r} (from {origin}) could not be built: {error}") from error
    return part
