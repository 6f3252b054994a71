// A stream as an object of a three.js scene, drawn by Spark (@sparkjsdev/spark). The page's import map, or a bundler,
// says where "three" and "@sparkjsdev/spark" are; the other modules are those of a package, in the folder "site" beside
// this file. Spark draws, sorts and blends; the attributes lie in float32 textures
// of this module, of which only changed rows are uploaded.

import { SplatMesh, dyno } from "@sparkjsdev/spark";
import * as THREE from "three";

import { pivotOf, viewsOf } from "./site/camera.js";
import { Player } from "./site/player.js";
import { ResidentScene } from "./site/resident.js";
import { GEOMETRY_TEXELS, colourFunction, colourTexels } from "./site/shaders.js";

/** Options of a SparkRenderer with which pictures look as these scenes were trained. */
export const AS_TRAINED = {
  sortRadial: false,
  preBlurAmount: 0.3,
  blurAmount: 0,
  maxStdDev: 3.33,
  minAlpha: 1 / 255,
  // Spark's own intermediate form otherwise has 8 bits for colours and 16 for centres, and cuts colours off at 1.
  accumExtSplats: true,
};

/** What Spark calls a SplatSource: the splats of the frame that a player shows. Splat `i` is what lies in slot `i`. */
class StreamSource {
  constructor(renderer) {
    this.renderer = renderer;
    this.scene = new ResidentScene(renderer.getContext());
    this.geometry = new dyno.DynoSampler2D({ key: "gsstreamGeometry", value: new THREE.ExternalTexture() });
    this.colours = new dyno.DynoSampler2D({ key: "gsstreamColours", value: new THREE.ExternalTexture() });
    this.state = null;
    this.most = 3;
    this.uploaded = 0;
    this.changed = false;
  }

  // What a player asks of its renderer.

  update(state) {
    this.state = state;
    this.scene.update(state);
    this.changed = true;
  }

  draw() {
    // three.js draws.
  }

  dispose() {
    for (const { texture } of [this.scene.textures.geometry, this.scene.textures.colours ?? {}])
      if (texture) this.scene.gl.deleteTexture(texture);
  }

  // What Spark asks of a source.

  prepareFetchSplat() {}

  getNumSplats() {
    return this.state ? this.scene.slots.used : 0;
  }

  hasRgbDir() {
    return Math.min(this.getNumSh(), this.most) > 0;
  }

  getNumSh() {
    return Math.max(this.scene.textures.degree, 0);
  }

  setMaxSh(most) {
    this.most = most;
  }

  fetchSplat({ index, viewOrigin }) {
    const degree = viewOrigin ? this.getNumSh() : 0;
    const texels = colourTexels(this.getNumSh());
    const [lines, colourLines] = [GEOMETRY_TEXELS, texels].map((number) => Math.floor(Math.log2(2048 / number)));
    const inTypes = { index: "int", geometry: "sampler2D", colours: "sampler2D" };
    const inputs = { index, geometry: this.geometry, colours: this.colours };
    if (viewOrigin) {
      inTypes.viewOrigin = "vec3";
      inputs.viewOrigin = viewOrigin;
    }
    return new dyno.Dyno({
      inTypes,
      outTypes: { gsplat: dyno.Gsplat },
      inputs,
      globals: () => [dyno.defineGsplat, colourFunction(degree)],
      statements: ({ inputs: from, outputs: { gsplat } }) =>
        dyno.unindentLines(`
          ivec2 texel = ivec2((${from.index} & ${2 ** lines - 1}) * ${GEOMETRY_TEXELS}, ${from.index} >> ${lines});
          vec4 first = texelFetch(${from.geometry}, texel, 0);
          vec4 quaternion = texelFetch(${from.geometry}, texel + ivec2(1, 0), 0);
          int at = (${from.index} & ${2 ** colourLines - 1}) * ${texels};
          vec3 rgb = seenFrom${degree}(${from.colours}, first.xyz - ${from.viewOrigin ?? "vec3(0.0)"}, at,
            ${from.index} >> ${colourLines});
          ${gsplat}.flags = first.w > -50.0 ? GSPLAT_FLAG_ACTIVE : 0u;
          ${gsplat}.index = ${from.index};
          ${gsplat}.center = first.xyz;
          ${gsplat}.scales = exp(texelFetch(${from.geometry}, texel + ivec2(2, 0), 0).xyz);
          ${gsplat}.quaternion = normalize(quaternion.yzwx);
          ${gsplat}.rgba = vec4(rgb, 1.0 / (1.0 + exp(-first.w)));
        `),
    }).outputs.gsplat;
  }

  forEachSplat(callback) {
    const { state } = this;
    for (let row = 0; row < (state?.number ?? 0); row += 1) {
      const { means, quats, scales, opacities, sh0 } = state.scene;
      const [w, x, y, z] = quats.subarray(4 * row, 4 * row + 4);
      callback(
        this.scene.slots.slotOf[row],
        new THREE.Vector3(...means.subarray(3 * row, 3 * row + 3)),
        new THREE.Vector3(...Array.from(scales.subarray(3 * row, 3 * row + 3), Math.exp)),
        new THREE.Quaternion(x, y, z, w).normalize(),
        1 / (1 + Math.exp(-opacities[row])),
        new THREE.Color(...Array.from(sh0.subarray(3 * row, 3 * row + 3), (v) => 0.5 + 0.28209479177387814 * v)),
      );
    }
  }

  /** Upload what changed since the last call; returns whether anything did. */
  flush() {
    if (!this.changed) return false;
    this.changed = false;
    const { gl, textures } = this.scene;
    // three.js may have left its own ways of unpacking behind, and does not know what is done behind its back.
    for (const name of ["UNPACK_FLIP_Y_WEBGL", "UNPACK_PREMULTIPLY_ALPHA_WEBGL"]) gl.pixelStorei(gl[name], false);
    for (const name of ["UNPACK_ROW_LENGTH", "UNPACK_SKIP_PIXELS", "UNPACK_SKIP_ROWS"]) gl.pixelStorei(gl[name], 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
    this.uploaded = textures.flush();
    this.renderer.resetState();
    for (const name of ["geometry", "colours"]) {
      if (this[name].value.sourceTexture === textures[name].texture) continue;
      this[name].value = new THREE.ExternalTexture(textures[name].texture);
      this[name].uniform.value = this[name].value;
    }
    return true;
  }
}

/**
 * A stream in a three.js scene. `mesh` is what to add; call `update` before every `renderer.render`. `player` plays,
 * pauses and seeks as on the page of a package.
 *
 * The recording's axes are kept (often z or -y is up): turn `mesh` as the scene needs it; `upright` gives a turn.
 */
export class SplatStream {
  /** `renderer`: the WebGLRenderer of the scene. `options`: those of Player. */
  constructor(renderer, options = {}) {
    this.source = new StreamSource(renderer);
    this.player = new Player(renderer.domElement, { ...options, renderer: this.source });
    this.mesh = new SplatMesh({ splats: this.source, raycastable: false });
    this.degree = -1;
  }

  /** Open a manifest or a .gss file; resolves when its first frame is decoded. */
  open(url) {
    return this.player.open(url);
  }

  /** Hand what changed since the last picture to the graphics. */
  update() {
    if (!this.source.flush()) return;
    if (this.degree !== this.source.getNumSh()) {
      this.degree = this.source.getNumSh();
      this.mesh.updateGenerator();
    }
    this.mesh.updateVersion();
  }

  /** Spark's `preBlurAmount` for the canvas as it is: drawn larger, a Gaussian still covers a pixel of the recording. */
  get blur() {
    const scale = this.source.renderer.domElement.height / this.player.view.height;
    return AS_TRAINED.preBlurAmount * Math.max(1, scale) ** 2;
  }

  /** The turn that takes the recording's up direction to y, as a Quaternion. */
  get upright() {
    return new THREE.Quaternion().setFromUnitVectors(
      new THREE.Vector3(...pivotOf(this.player.views).up),
      new THREE.Vector3(0, 1, 0),
    );
  }

  /** Put a PerspectiveCamera where a camera of the recording stands, as far as such a camera can show its picture. */
  place(camera, id = null) {
    const views = viewsOf(this.player.state.meta);
    const view = views.find((one) => one.id === id) ?? views[0];
    const [x, y, z] = [view.right, view.down.map((v) => -v), view.forward.map((v) => -v)];
    const basis = new THREE.Matrix4().makeBasis(...[x, y, z].map((axis) => new THREE.Vector3(...axis)));
    basis.setPosition(...view.eye).premultiply(this.mesh.matrixWorld);
    basis.decompose(camera.position, camera.quaternion, new THREE.Vector3());
    camera.fov = (360 / Math.PI) * Math.atan(view.height / (2 * view.fy));
    camera.updateProjectionMatrix();
    // The principal point need not lie in the middle, and pixels need not be square.
    const matrix = camera.projectionMatrix;
    matrix.elements[0] = ((2 * view.fx) / view.width) * ((view.width / view.height) / camera.aspect);
    matrix.elements[8] = 1 - (2 * view.cx) / view.width;
    matrix.elements[9] = (2 * view.cy) / view.height - 1;
    camera.projectionMatrixInverse.copy(matrix).invert();
  }

  dispose() {
    this.player.dispose();
    this.mesh.dispose();
  }
}
