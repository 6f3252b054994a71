"""Our binary glTF by the code of others: Khronos' validator, the loaders of three.js and PlayCanvas, and a picture."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from browser_runs import in_browser, needs_browser, serving
from moving_scenes import make_gaussians, make_meta
from node_runs import NODE, needs_node
from pictures import decoded, psnr

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Layout
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.world import World
from gsstream.packet import KeyState, StreamWriter, encode_key
from gsstream.player.activated import activated
from gsstream.player.export import export
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render, to_bytes
from gsstream.player.software import render_numpy

MODULES = Path(os.environ.get("GSSTREAM_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))


def needs(*packages: str) -> pytest.MarkDecorator:
    lacking = [name for name in packages if not (MODULES / name / "package.json").is_file()]
    return pytest.mark.skipif(bool(lacking), reason=f"npm packages are missing (npm install {' '.join(lacking)})")


def in_node(code: str, *arguments: Path) -> object:
    """What a module prints as JSON; it finds the packages of npm."""
    command = [str(NODE), "--input-type=module", "-", *map(str, arguments)]
    done = subprocess.run(command, input=code, capture_output=True, text=True, timeout=300, cwd=MODULES.parent)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


VALIDATOR = """
import { readFileSync } from "node:fs";
import validator from "gltf-validator";
const report = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 0 });
console.log(JSON.stringify(report.issues.messages));
"""
THREE = """
import { readFileSync } from "node:fs";
globalThis.self = globalThis;
const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
const { GLTFGaussianSplatLoaderExtension } = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
const file = readFileSync(process.argv[2]);
const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.length);
const loader = new GLTFLoader();
const points = await loader.parseAsync(data, "");
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const splats = await loader.parseAsync(data, "");
const found = {};
splats.scene.traverse((object) => {
  if (!object.isGaussianSplat) return;
  object.updateWorldMatrix(true, false);
  found.matrix = object.matrixWorld.toArray();
  for (const [name, { array }] of Object.entries(object.splatGeometry.attributes)) {
    found[name] = Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");
  }
});
points.scene.traverse((object) => { if (object.isPoints) found.colours = object.geometry.attributes.color.itemSize; });
console.log(JSON.stringify(found));
"""
NUMPY = PlayerRenderer("numpy", render_numpy)
#: Words of a Gaussian in which three keeps the coefficients of a degree, as bytes.
WORDS = {1: 3, 2: 4, 3: 6}
#: A turn about an axis of its own, a unit and a place: all of it is in the file's numbers.
TURNED = World((0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6), (3.0, -2.0, 1.0), 2.5)


def make_stream(path: Path, rest: int, scene: Gaussians | None = None) -> Path:
    """One frame, from a camera whose picture is wide enough for PlayCanvas to cut none of its splats."""
    gaussians = make_gaussians(np.random.default_rng(4), 200, rest) if scene is None else scene
    viewmats = np.tile(np.eye(4), (1, 1, 1))
    viewmats[:, 2, 3] = 4.0
    K = np.array([[[180.0, 0, 96], [0, 180.0, 72], [0, 0, 1]]])
    rig = Cameras(("one",), viewmats, K, 192, 144, 0.02)
    meta = dataclasses.replace(make_meta(), train=rig, test=rig, world=TURNED)
    layout = Layout(np.int32([len(gaussians)]), np.zeros(len(gaussians), np.uint8), np.float32([1.0]))
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(gaussians, layout, meta), frame=0))
    return path


def numbers(found: dict[str, str], name: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(found[name]), dtype)


def turned(stream: Path) -> np.ndarray:
    """[N, 3] the centres where they are to be: up, which is z of a stream with a world, along y."""
    with Playback(stream) as playback:
        x, y, z = (TURNED.scale * playback.state_at(0).means.astype(float)).T
    turn = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    return np.stack([-y, z, -x], 1) + turn @ TURNED.matrix.T @ TURNED.offset


@needs_node
@needs("gltf-validator")
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_the_validator_finds_nothing_but_names_that_it_does_not_know(tmp_path, rest):
    (file,) = export(make_stream(tmp_path / "s.gss", rest), tmp_path / "out", "glb")
    messages = in_node(VALIDATOR, file)
    assert isinstance(messages, list)
    names = [m for m in messages if m["code"] != "UNSUPPORTED_EXTENSION"]
    assert len(names) < len(messages), "the validator knows the extension: hold it to no errors at all"
    assert {m["code"] for m in names} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    where = "/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:"
    assert all(m["pointer"].startswith(where) for m in names)
    assert len(names) == 3 + 1 + rest


@needs_node
@needs("three")
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_three_reads_the_same_numbers(tmp_path, rest):
    stream = make_stream(tmp_path / "s.gss", rest)
    (file,) = export(stream, tmp_path / "out", "glb")
    found = in_node(THREE, file)
    assert isinstance(found, dict)
    with Playback(stream) as playback:
        scene = playback.state_at(0)
    number = len(scene)
    assert found["matrix"] == np.eye(4).ravel().tolist()
    assert found["colours"] == 4, "without the extension: coloured points"
    assert numbers(found, "position", "<f4").reshape(number, 3) == pytest.approx(turned(stream), abs=2e-6)
    # Covariances in the file's axes: those of the stream, turned.
    quats = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    w, x, y, z = quats.T.astype(float)
    rotations = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    turn = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    axes = turn @ rotations * (TURNED.scale * np.exp(scene.scales.astype(float)))[:, None]
    covariances = (axes @ axes.transpose(0, 2, 1)).reshape(number, 9)[:, [0, 1, 2, 4, 5, 8]]
    theirs = numbers(found, "covariance", "<f4").reshape(number, 6)
    assert theirs == pytest.approx(covariances, rel=1e-3, abs=1e-6)
    alphas = 1 / (1 + np.exp(-scene.opacities.astype(float)))
    shown = np.clip(255 * np.concatenate([0.5 + SH0 * scene.sh0[:, 0], alphas[:, None]], 1), 0, 255)
    assert numbers(found, "color", "u1").reshape(number, 4) == pytest.approx(shown, abs=0.51)
    with Playback(stream) as playback:
        world = World(tuple((turn @ TURNED.matrix.T @ TURNED.matrix).ravel()))
        wanted = activated(world.gaussians(playback.state_at(0))).harmonics[:, 1:]
    at = 0
    for degree in range(1, math.isqrt(rest + 1)):
        width = 2 * degree + 1
        packed = numbers(found, f"sphericalHarmonics{degree}", "u1").reshape(number, 4 * WORDS[degree])
        coefficients = packed[:, : 3 * width].reshape(number, width, 3) / 128 - 1
        assert coefficients == pytest.approx(np.clip(wanted[:, at : at + width], -1, 127 / 128), abs=0.51 / 128)
        at += width
    assert at == rest


PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>splats</title><canvas></canvas>
<script type="importmap">{"imports": {"playcanvas": "./node_modules/playcanvas/build/playcanvas.mjs"}}</script>
<script type="module">
  import { Application, Asset, Color, Entity, FILLMODE_NONE, GSPLATDATA_LARGE, Mat4, RESOLUTION_AUTO }
    from "playcanvas";
  const canvas = document.querySelector("canvas");
  const app = new Application(canvas, { graphicsDeviceOptions: { antialias: false } });
  app.setCanvasFillMode(FILLMODE_NONE);
  app.setCanvasResolution(RESOLUTION_AUTO);
  Object.assign(canvas.style, { width: "192px", height: "144px" });
  app.resizeCanvas();
  Object.assign(app.scene.gsplat, {
    dataFormat: GSPLATDATA_LARGE, alphaClipForward: 1 / 255, minPixelSize: 0, minContribution: 0,
  });
  const camera = new Entity("camera");
  camera.addComponent("camera", { farClip: 1000, fov: FOV, clearColor: new Color(0.1, 0.2, 0.3) });
  app.root.addChild(camera);
  const pose = new Mat4().set(POSE);
  camera.setPosition(pose.getTranslation());
  camera.setEulerAngles(pose.getEulerAngles());
  app.start();
  const asset = new Asset("splats", "container", { url: "splats.glb" });
  app.assets.add(asset);
  asset.ready(() => {
    const splats = new Entity("splats");
    splats.addComponent("gsplat", { asset: asset.resource.gsplats[0] });
    app.root.addChild(splats);
    Object.assign(globalThis, { app, data: asset.resource.gsplats[0].resource.gsplatData });
  });
  app.assets.load(asset);
</script></html>
"""
THREE_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>splats</title>
<script type="importmap">{"imports": {
  "three": "./node_modules/three/build/three.webgpu.js", "three/webgpu": "./node_modules/three/build/three.webgpu.js",
  "three/tsl": "./node_modules/three/build/three.tsl.js", "three/addons/": "./node_modules/three/examples/jsm/"
}}</script>
<script type="module">
  import { Color, LinearSRGBColorSpace, Matrix4, PerspectiveCamera, Scene, WebGPURenderer } from "three/webgpu";
  import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
  import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
  const renderer = new WebGPURenderer({ forceWebGL: true, antialias: false });
  await renderer.init();
  renderer.setPixelRatio(1);
  renderer.setSize(192, 144);
  renderer.outputColorSpace = LinearSRGBColorSpace;  // colours are shown as they are in the file
  document.body.append(renderer.domElement);
  const scene = new Scene(), camera = new PerspectiveCamera(FOV, 192 / 144, 0.05, 1000);
  scene.background = new Color().setRGB(0.1, 0.2, 0.3, LinearSRGBColorSpace);
  new Matrix4().fromArray(POSE).decompose(camera.position, camera.quaternion, camera.scale);
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  scene.add((await loader.loadAsync("splats.glb")).scene);
  for (let i = 0; i < 6; i += 1) {
    renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  renderer.render(scene, camera);
  const copy = new OffscreenCanvas(192, 144).getContext("2d");
  copy.drawImage(renderer.domElement, 0, 0);
  let text = "";
  for (const byte of copy.getImageData(0, 0, 192, 144).data) text += String.fromCharCode(byte);
  renderer.shown = btoa(text);
  globalThis.renderer = renderer;
</script></html>
"""
NAMES = ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity"]
NUMBERS = """(() => {
  const names = %s, columns = names.map((name) => Array.from(data.getProp(name)));
  return columns;
})()"""
PICTURE = """(async () => {
  for (let i = 0; i < 20; i += 1) {
    await new Promise((resolve) => app.once("frameend", resolve));
    await new Promise((resolve) => setTimeout(resolve, 60));
  }
  const pixels = new Uint8Array(192 * 144 * 4);
  await new Promise((resolve) => app.once("frameend", () => {
    const { gl } = app.graphicsDevice;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, 192, 144, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    resolve();
  }));
  let text = "";
  for (const byte of pixels) text += String.fromCharCode(byte);
  return btoa(text);
})()"""


def placed(stream: Path, file: Path) -> tuple[str, str]:
    """Angle and pose, as PlayCanvas takes them, of the stream's camera in the coordinates of a GLB."""
    data = file.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    back = np.array(document["scenes"][0]["extras"]["toRecording"]).reshape(4, 4).T
    with Playback(stream) as playback:
        rig = playback.meta.world.cameras(playback.cameras("test"))
    pose = np.linalg.inv(rig.viewmats[0] @ back) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return str(math.degrees(2 * math.atan(72 / 180))), json.dumps(pose.T.ravel().tolist())


def strong_harmonics() -> Gaussians:
    """Colours that turn with the view, in splats of some pixels each."""
    scene = make_gaussians(np.random.default_rng(4), 200, 15)
    return dataclasses.replace(
        scene,
        means=0.8 * scene.means,
        scales=np.clip(scene.scales, -3.4, -2.4),
        sh0=(0.5 * np.tanh(scene.sh0)).astype(np.float32),
        shN=2 * scene.shN,
    )


def on_page(folder: Path, stream: Path, file: Path, page: str, ready: str, *asked: str) -> list:
    """What a page that shows a GLB from the stream's camera answers, once it is ready."""
    fov, pose = placed(stream, file)
    (folder / "page").mkdir()
    (folder / "page" / "index.html").write_text(page.replace("FOV", fov).replace("POSE", pose))
    (folder / "page" / "splats.glb").write_bytes(file.read_bytes())
    (folder / "page" / "node_modules").symlink_to(MODULES)
    with serving(folder / "page") as (url, _):
        steps = [["go", f"{url}/index.html"], ["until", ready], *(["evaluate", question] for question in asked)]
        return in_browser(steps, folder, size=(400, 300))[2:]


def likeness(stream: Path, picture: np.ndarray) -> float:
    """Decibels between a picture and ours, which tells harmonics of another sign."""
    with Playback(stream) as playback:
        scene, rig = playback.state_at(0), playback.cameras("test")
    wrong = dataclasses.replace(scene, shN=-scene.shN)
    ours, other = (to_bytes(render(s, rig, 0, (0.1, 0.2, 0.3), NUMPY)) for s in (scene, wrong))
    print("decibels", psnr(ours, picture), "with harmonics of the other sign", psnr(ours, other))
    assert psnr(ours, other) < 30
    return psnr(ours, picture)


@needs_browser
@needs("playcanvas")
def test_playcanvas_reads_the_same_numbers_and_shows_the_same_picture(tmp_path):
    stream = make_stream(tmp_path / "s.gss", 15, strong_harmonics())
    (file,) = export(stream, tmp_path / "out", "glb")
    names = [*NAMES, *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    ready = "typeof data !== 'undefined'"
    columns, text = on_page(tmp_path, stream, file, PAGE, ready, NUMBERS % json.dumps(names), PICTURE)
    theirs = np.array(columns, float).T
    with Playback(stream) as playback:
        turn = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
        scene = playback.state_at(0)
        world = World(tuple((turn).astype(float).ravel()), (0.0, 0.0, 0.0), TURNED.scale)
        ours = activated(world.gaussians(scene))
        means = turned(stream)
    # The engine puts splats in an order of its own.
    order = np.abs(theirs[:, None, :3] - means).max(2).argmin(0)
    assert len(set(order)) == len(means)
    theirs = theirs[order]
    assert theirs[:, :3] == pytest.approx(means, abs=2e-6)
    signs = np.sign((theirs[:, [4, 5, 6, 3]] * ours.quats).sum(1))[:, None]
    assert theirs[:, [4, 5, 6, 3]] * signs == pytest.approx(ours.quats, abs=1e-6)
    assert theirs[:, 7:10] == pytest.approx(ours.scales, rel=1e-6)
    assert theirs[:, 10] == pytest.approx(ours.opacities, rel=1e-6)
    assert theirs[:, 11:14] == pytest.approx(ours.harmonics[:, 0], abs=1e-6)
    assert theirs[:, 14:].reshape(-1, 3, 15).transpose(0, 2, 1) == pytest.approx(ours.harmonics[:, 1:], abs=1e-6)
    assert likeness(stream, decoded(text, 192, 144)[::-1]) >= 40


@needs_browser
@needs("three")
def test_three_shows_the_same_picture(tmp_path):
    """It ends splats at two standard deviations, and keeps colours and coefficients as bytes: hence the decibels."""
    stream = make_stream(tmp_path / "s.gss", 15, strong_harmonics())
    (file,) = export(stream, tmp_path / "out", "glb")
    (text,) = on_page(tmp_path, stream, file, THREE_PAGE, "globalThis.renderer?.shown", "globalThis.renderer.shown")
    assert likeness(stream, decoded(text, 192, 144)) >= 35
