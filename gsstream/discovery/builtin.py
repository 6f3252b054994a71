"""The parts that ship with gsstream, registered through the hooks that every plugin uses."""

from __future__ import annotations

from gsstream.spec import CommandSpec, ComponentSpec, Kind, MethodSpec, hookimpl


def _part(kind: Kind, name: str, target: str, summary: str) -> ComponentSpec:
    return ComponentSpec(kind=kind, name=name, target=f"gsstream.{target}", summary=summary)


def _source(name: str, summary: str) -> ComponentSpec:
    return _part("source", name, "input.recordings.open:open_source", summary)


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        _part("structure", "flat", "parts.structure.flat:Flat", "each Gaussian is its own node"),
        _part("confidence", "uniform", "parts.confidence.uniform:Uniform", "everything may have changed"),
        _part("propagation", "group-max", "parts.propagation.group_max:GroupMax", "maximum over the members of a node"),
        _part("gate", "always-open", "parts.gate.always_open:AlwaysOpen", "no sparsity: every gate is 1"),
        _part("regularizer", "none", "parts.regularizer.none:NoRegularizer", "nothing costs anything"),
        _part("update", "additive", "parts.update.additive:Additive", "gated change added to raw attributes"),
        _part("update", "none", "parts.update.none:NoUpdate", "no residual: motion and growth alone"),
        _part("motion", "still", "parts.motion.none:Still", "nothing is carried along"),
        _part("motion", "rigid", "parts.motion.rigid:Rigid", "one fitted rigid motion per group"),
        _part("growth", "copies", "parts.growth.copying:Copies", "Gaussians copied where the gradient is large"),
        _part("growth", "none", "parts.growth.none:NoGrowth", "nothing is added and nothing is removed"),
        _part(
            "streaming_method",
            "parts",
            "engine.run.parts_method:PartsMethod",
            "the slots of the recipe, one after the other",
        ),
        _part("streaming_method", "hold", "method.static:Hold", "frame 0 and nothing after it"),
        _part("renderer", "reference", "parts.backend.reference:ReferenceRenderer", "pure torch: slow, the truth"),
        _source("demo", "the small recording that ships with gsstream"),
        _source("synthetic", "an analytic moving scene: synthetic:KEY=VALUE&..."),
        _source("watch", "a folder that grows: watch:DIR?KEY=VALUE&..."),
        _source("folder", "a folder of images per camera with cameras.json"),
        _source("n3dv", "cam00.mp4 ... (or frames) and poses_bounds.npy"),
        _source("meetroom", "cam_0.mp4 ... (or frames) and poses_bounds.npy"),
        _source("enerf", "EasyMocap: intri.yml, extri.yml, images/00/"),
        _source("panoptic", "Dynamic 3D Gaussians: train_meta.json, ims/"),
        _source("colmap", "a COLMAP model with images or videos"),
        _source("nerfstudio", "transforms.json with images or videos"),
    ]


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    return [
        MethodSpec(
            name="dense",
            recipe="gsstream.recipe:methods/dense.yaml",
            summary="every Gaussian may change in every frame: the baseline",
        ),
        MethodSpec(
            name="hold",
            recipe="gsstream.recipe:methods/hold.yaml",
            summary="frame 0 and nothing after it: the floor",
        ),
    ]


#: group -> name -> (target in ``gsstream.cli``, first line of its help)
_COMMANDS = {
    "Encode": {
        "run": ("run:run", "Encode a recording as a stream of 3D Gaussians."),
        "scene": ("scene:app", "Prepare and validate scenes."),
    },
    "Watch": {
        "play": ("streams:play", "Decode a stream and render it, without torch or the recording."),
        "open": ("open:open_stream", "Show a stream in the browser; Ctrl-C ends."),
        "export": ("deliver:export", "Write a stream for other programs, or as a page for any web server."),
        "info": ("info:info", "Say what a stream holds: method, cameras, packets and their sizes."),
    },
    "Evaluate": {
        "evaluate": ("evaluate:evaluate", "Render the decoded frames and compare them with the test cameras."),
    },
    "Extend": {
        "doctor": ("doctor:doctor", "Say what this installation draws and encodes with, and what is missing."),
        "methods": ("methods:methods", "List the methods that --method may name, or show one."),
        "recipe": ("recipe:recipe", "Print a method's recipe as YAML, with the provenance of every value."),
        "plugins": ("plugins:plugins", "List all plugins and the parts they ship, or show one part."),
        "check": ("check:check", "Check that a part, a method, or everything in a plugin keeps its contract."),
        "conformance": (
            "conformance:conformance",
            "Play the streams of the conformance suite with a decoder, and compare the hash of every frame.",
        ),
        "new-plugin": ("scaffold:new_plugin", "Write a distribution with one working part, its test and README."),
    },
}


@hookimpl
def gsstream_commands() -> list[CommandSpec]:
    return [
        CommandSpec(name=name, target=f"gsstream.cli.{target}", summary=summary, group=group)
        for group, commands in _COMMANDS.items()
        for name, (target, summary) in commands.items()
    ]
