"""The parts that ship with gsstream, registered through the hooks that every plugin uses."""

from __future__ import annotations

from gsstream.spec import CommandSpec, ComponentSpec, Kind, MethodSpec, hookimpl


def _part(kind: Kind, name: str, target: str, summary: str) -> ComponentSpec:
    return ComponentSpec(kind=kind, name=name, target=f"gsstream.{target}", summary=summary)


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        _part("structure", "flat", "structure.flat:Flat", "each Gaussian is its own node"),
        _part("confidence", "uniform", "confidence.uniform:Uniform", "everything may have changed"),
        _part("propagation", "group-max", "propagation.group_max:GroupMax", "a node is as suspect as its worst member"),
        _part("gate", "always-open", "gate.always_open:AlwaysOpen", "no sparsity: every gate is 1"),
        _part("regularizer", "none", "regularizer.none:NoRegularizer", "nothing costs anything"),
        _part("update", "additive", "residual.additive:Additive", "gated change added to raw attributes"),
        _part("motion", "still", "motion.still:Still", "nothing is carried along"),
        _part("motion", "coasting", "motion.coasting:Coasting", "what moved goes on moving"),
        _part("motion", "rigid", "motion.rigid:Rigid", "one fitted rigid motion per group"),
        _part("growth", "none", "growth.none:NoGrowth", "nothing is born and nothing leaves"),
        _part("stepper", "parts", "engine.method.parts:PartsMethod", "the slots of the recipe, one after the other"),
        _part("stepper", "hold", "method.hold:Hold", "frame 0 and nothing after it"),
        _part("renderer", "reference", "render.reference:ReferenceRenderer", "pure torch, slow, defines the truth"),
        _part("loss", "reference", "loss.photometric:ReferenceLoss", "L1 + D-SSIM in torch, slow, defines the truth"),
        _part("optimiser", "reference", "optimiser.adam:ReferenceAdam", "Adam by rows in torch, defines the truth"),
        _part("source", "demo", "source.open:open_source", "the small recording that ships with gsstream"),
        _part("source", "synthetic", "source.open:open_source", "an analytic moving scene: synthetic:KEY=VALUE&..."),
        _part("source", "watch", "source.open:open_source", "a folder that grows: watch:DIR?KEY=VALUE&..."),
        _part("source", "folder", "source.open:open_source", "a folder of images per camera with cameras.json"),
        _part("source", "n3dv", "source.open:open_source", "cam00.mp4 ... (or frames) and poses_bounds.npy"),
        _part("source", "meetroom", "source.open:open_source", "cam_0.mp4 ... (or frames) and poses_bounds.npy"),
        _part("source", "enerf", "source.open:open_source", "EasyMocap: intri.yml, extri.yml, images/00/"),
        _part("source", "panoptic", "source.open:open_source", "Dynamic 3D Gaussians: train_meta.json, ims/"),
        _part("source", "colmap", "source.open:open_source", "a COLMAP model with images or videos"),
        _part("source", "nerfstudio", "source.open:open_source", "transforms.json with images or videos"),
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
        "package": ("package:package", "Write a folder with the browser player and the stream for any web server."),
        "serve": ("serve:serve", "Serve the player and a stream, recorded or live (extra: serve)."),
        "export": ("deliver:export", "Write decoded frames to files that other programs open."),
        "info": ("info:info", "Say what a stream holds: method, cameras, packets and their sizes."),
    },
    "Evaluate": {
        "evaluate": ("evaluate:evaluate", "Render the decoded frames and compare them with the test cameras."),
    },
    "Extend": {
        "methods": ("methods:methods", "List the methods that --method may name, or show one."),
        "recipe": ("recipe:recipe", "Print a method's recipe as YAML, with the provenance of every value."),
        "plugins": ("plugins:plugins", "List all plugins and the parts they ship, or show one part."),
        "check": ("check:check", "Check that a part, a method, or everything in a plugin keeps its contract."),
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
