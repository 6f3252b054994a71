"""What all parts promise: settings, freezing, declaration; and of some kinds purity, shapes and equivariance."""

from __future__ import annotations

import copy
import functools
import inspect
import json
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ValidationError

from gsstream.core.errors import STRANGERS, InputError
from gsstream.core.kinds import CONTRACTS
from gsstream.core.part import Part
from gsstream.engine.assembly.part_in_use import line_of
from gsstream.parts.gate.base import GateSampler
from gsstream.testing import device as device
from gsstream.testing.cases import EXTREMES, World, fingerprint, get_case
from gsstream.testing.compare import ROUNDING, Poison, all_equal, behaviour_of, draw, finite, outputs
from gsstream.testing.registry import BEHAVED, MIN_REASON, Advice, Skip, SourceUnderTest, check, checks_for, kind_of

ALL = tuple(CONTRACTS)


@check("common", kinds=ALL)
def check_config_round_trip(part: Part) -> None:
    """Settings survive JSON; unknown keys are refused by name; every setting is described; the schema exports."""
    model = type(part.config)
    again = model.model_validate(json.loads(part.config.model_dump_json()))
    assert again == part.config, f"settings changed on the way through JSON: expected {part.config!r}, got {again!r}"
    try:
        model.model_validate({**part.config.model_dump(), "no_such_setting": 1})
    except ValidationError as error:
        assert "no_such_setting" in str(error), f"the error does not name the unknown key: {error}"
    else:
        raise AssertionError(f"{model.__qualname__} accepts the unknown key 'no_such_setting'")
    bare = [name for name, field in _fields(model) if not field.description]
    assert not bare, f"settings without a description: {', '.join(bare)}"
    assert json.dumps(model.model_json_schema()), "the JSON schema does not export"


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, field in model.model_fields.items():
        yield prefix + name, field
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _fields(field.annotation, f"{prefix}{name}.")


@check("common", kinds=ALL)
def check_frozen_and_final(part: Part) -> None:
    """No attribute can be set, the class is final, repr shows the settings, copies and pickles are equal."""
    cls = type(part)
    for name in ("config", "scratch"):
        try:
            setattr(part, name, getattr(part, name, None))
        except AttributeError:
            continue
        raise AssertionError(f"attribute {name!r} of {cls.__name__} can be set: state belongs into arguments")
    try:
        part.config.__setattr__("scratch", None)
    except ValidationError:
        pass
    else:
        raise AssertionError(f"settings of {cls.__name__} can be set: derive Config from PartConfig, which is frozen")
    assert vars(cls).get("__final__"), f"{cls.__name__} is not marked @final: change behaviour by wrapping"
    assert repr(part.config) in repr(part), f"repr does not show the settings: {part!r}"
    for how, twin in (("deepcopy", copy.deepcopy(part)), ("pickle", pickle.loads(pickle.dumps(part)))):
        assert twin == part, f"{how} gives another part: expected {part!r}, got {twin!r}"
        assert hash(twin) == hash(part), f"{how} gives an equal part with another hash"


@check("common", kinds=ALL)
def check_docstring(part: Part) -> None:
    """The class says what it is, in a docstring of its own."""
    text = inspect.cleandoc(vars(type(part)).get("__doc__") or "")
    assert text, f"{type(part).__name__} has no docstring of its own"


@check("common", kinds=ALL)
def check_citation(part: Part) -> None:
    """The class attribute ``source`` says where the idea is from: a citation, or who had it first; else a warning."""
    cited = type(part).source
    if not (isinstance(cited, str) and cited.strip()):
        raise Advice(
            f"{type(part).__name__}.source: a citation, e.g. 'S2GS, section 3.2', or the name of your distribution "
            f"would tell where the idea is from; got {cited!r}"
        )


@check("common", kinds=ALL)
def check_denials(part: Part) -> None:
    """The part denies only checks that are made on its kind, each with a reason of at least 20 characters."""
    made = {entry.name for entry in checks_for(kind_of(part))}
    for name, reason in part.denials().items():
        assert name in made, f"denied: no check named {name!r} is made on a {kind_of(part)}"
        assert isinstance(reason, str) and len(reason.strip()) >= MIN_REASON, (
            f"denied[{name!r}]: expected a reason of at least {MIN_REASON} characters, got {reason!r}"
        )


@check("common", kinds=(*ALL, "source"))
def check_cheap_spec(part: Part | SourceUnderTest) -> None:
    """The plugin that declares the part imports without torch, and its target is this class."""
    cls: Any = part.target if isinstance(part, SourceUnderTest) else type(part)
    target = f"{cls.__module__}:{cls.__name__}"
    from gsstream.discovery.catalog import load_catalog

    entries = load_catalog().entries
    owners = [e.plugin for e in entries.values() if getattr(e.spec, "target", None) == target]
    if not owners:
        raise Skip(f"no installed plugin declares {target}")
    module = _plugin_module(owners[0])
    heavy = imports_torch(module)
    assert not heavy, f"importing {module}, which declares {cls.__name__}, imports torch: {heavy}"


def _plugin_module(plugin: str) -> str:
    from importlib.metadata import entry_points

    points = [point for point in entry_points(group="gsstream") if point.name == plugin]
    return points[0].module if points else "gsstream.discovery.builtin"


def imports_torch(module: str) -> str:
    """Say why a process of its own could not import a module without torch; empty when it could."""
    return _imports_torch(module, os.pathsep.join(filter(None, sys.path)))


@functools.cache
def _imports_torch(module: str, path: str) -> str:
    code = (
        f"import sys, importlib; importlib.import_module({module!r}); "
        "sys.exit('torch is loaded' if 'torch' in sys.modules else 0)"
    )
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    return result.stderr.strip() if result.returncode else ""


@check("common", kinds=BEHAVED)
def check_pure(part: Part) -> None:
    """The same inputs give the same bits twice; inputs are left as they were; no .grad is left behind."""
    case = get_case("moving")
    before = fingerprint(case)
    first = outputs(part, case)
    assert fingerprint(case) == before, f"{type(part).__name__} changed its inputs"
    all_equal("second call with the same inputs", outputs(part, case), first)
    tensors = [value for _, value in case.gaussians.items()] + [case.logits, case.residual]
    assert all(value.grad is None for value in tensors), "a .grad was left behind on an input"


@check("common", kinds=BEHAVED)
def check_rng_isolated(part: Part) -> None:
    """The global generators of torch, numpy and python are untouched; a generator's seed alone decides the noise."""
    state = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()  # type: ignore[index]
    outputs(part, get_case("moving"))
    changed = [
        name
        for name, same in (
            ("torch", torch.equal(state[0], torch.get_rng_state())),
            ("numpy", np.array_equal(state[1], np.random.get_state()[1])),  # type: ignore[index]
            ("python", state[2] == random.getstate()),
        )
        if not same
    ]
    assert not changed, f"global generators used: {', '.join(changed)}; draw from the generator that is given"
    if isinstance(part, GateSampler) and part.claims().stochastic:
        one, same, other = (draw(part, 64, seed) for seed in (1, 1, 2))
        assert one is not None and same is not None and other is not None, "claims to be stochastic, but noise is None"
        assert torch.equal(one, same), "two generators of the same seed give different noise"
        assert not torch.equal(one, other), "generators of different seeds give the same noise"


@check("common", kinds=BEHAVED)
def check_dtype_and_device(part: Part) -> None:
    """Outputs stay float32, or float64 where logits are an input of that type, and on the input's device."""
    for case in (get_case("cloud"), get_case("cloud").double()):
        for name, value in outputs(part, case).items():
            assert isinstance(value, torch.Tensor), f"{name}: expected a tensor, got {type(value).__name__}"
            assert value.device == case.logits.device, f"{name}: expected {case.logits.device}, got {value.device}"
            if value.dtype.is_floating_point:
                want = case.logits.dtype if behaviour_of(part).keeps_precision else torch.float32
                assert value.dtype == want, f"{name}: expected {want}, got {value.dtype} from {case.logits.dtype} input"


@check("common", kinds=BEHAVED)
def check_extremes(part: Part) -> None:
    """Worlds of no, one, identical, collinear, far, tiny, vast, thin and unseen Gaussians work; nothing is NaN."""
    for name in EXTREMES:
        try:
            found = outputs(part, get_case(name))
        except STRANGERS as error:
            said = error if isinstance(error, AssertionError) else f"raised {type(error).__name__}: {error}"
            raise AssertionError(f"world {name!r}: {said}{line_of(error, part)}") from error
        for output, value in found.items():
            if value.dtype.is_floating_point:
                finite(f"world {name!r}: {output}", value)


@check("common", kinds=BEHAVED)
def check_rejects_nonfinite(part: Part) -> None:
    """NaN and +-Inf are refused by name; a regularizer may hand them on. They are never silently repaired."""
    for poison in behaviour_of(part).poisons:
        one, other = (outputs(part, _poisoned(poison, value)) for value in poison.usual)
        read = [name for name, value in one.items() if not torch.equal(value, other[name])]
        for bad in (float("nan"), float("inf"), -float("inf")):
            try:
                got = outputs(part, _poisoned(poison, bad))
            except InputError as error:
                text = str(error)
                assert poison.named in text, f"{poison.what} was {bad}, and the message does not name it: {text}"
                assert "finite" in text or "nan" in text or "inf" in text, f"the message does not say why: {text}"
                continue
            repaired = [name for name in read if bool(torch.isfinite(got[name]).all())]
            assert not repaired, f"{poison.what} was {bad}, and it was repaired silently; expected an InputError"
            # Functions that are called in every iteration may hand such a value on: it shows in the loss.
            allowed = behaviour_of(part).hands_on or not read
            assert allowed, f"{poison.what} was {bad}, and it was passed on; expected an InputError"


def _poisoned(poison: Poison, value: float) -> World:
    """The cloud with one value replaced."""
    case = get_case("cloud")
    poison.put(case, value)
    return case


@check("common", kinds=BEHAVED)
def check_permutation(part: Part) -> None:
    """Permuting the Gaussians permutes what there is per Gaussian and changes nothing else."""
    case = get_case("cloud")
    order = torch.randperm(len(case.logits), generator=torch.Generator().manual_seed(3))
    first, second = outputs(part, case), outputs(part, case.permuted(order))
    behaviour = behaviour_of(part)
    for name in list(first):
        if behaviour.no_order is not None and name.startswith(behaviour.no_order):
            del first[name], second[name]
        elif behaviour.by_gaussian:
            first[name] = first[name][order]
    all_equal("permuted Gaussians", second, first, tolerance=1e-4, why=f"{ROUNDING}; splats at equal depth may swap")
