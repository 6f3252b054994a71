"""Every declaration is well formed, and none is true."""

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl

_TARGETS = {
    "no-module": "a_module_nobody_has:Gate",
    "no-class": "gsstream.parts.gate.always_open:Gate",
    "wrong-kind": "gsstream.parts.structure.flat:Flat",
    "not-a-class": "gsstream.parts.gate.base:__doc__",
    "unfinished": "gsstream.parts.gate.base:GateSampler",
}


@hookimpl
def gsstream_components():
    return [ComponentSpec(kind="gate", name=name, target=target, summary="lies") for name, target in _TARGETS.items()]


@hookimpl
def gsstream_methods():
    return [MethodSpec(name="no-recipe", recipe="gsstream.recipe:methods/absent.yaml", summary="lies")]
