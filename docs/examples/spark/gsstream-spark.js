// A stream as an object of a three.js scene, drawn by Spark (@sparkjsdev/spark). The page's import map, or a bundler,
// says where "three" and "@sparkjsdev/spark" are; the other modules are those of a package, in the folder "site" beside
// this file. Spark draws, sorts and blends; the attributes lie in float32 textures
// of this module, of which only changed rows are uploaded.

import { SplatMesh, dyno } from "@sparkjsdev/spark";
import * as THREE from "three";

import { cameraOf } from "./site/camera.js";
import { Player } from "./site/player.js";
import { SceneTextures } from "./site/scene-textures.js";
import { colourFunction } from "./site/shaders.js";
import { GEOMETRY_TEXELS, colourTexels, shiftOf } from "./site/texels.js";

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
    this.textures = new SceneTextures(renderer.getContext());
    this.positions = new Float32Array(0);
    this.geometry = new dyno.DynoSampler2D({ key: "gsstreamGeometry", value: new THREE.ExternalTexture() });
    this.colours = new dyno.DynoSampler2D({ key: "gsstreamColours", value: new THREE.ExternalTexture() });
    this.most = 3;
    this.uploaded = 0;
    this.changed = false;
    /** Colour behind everything. */
    this.background = [0, 0, 0];
  }

  // What a player asks of its renderer.

  take(update, deadline) {
    const { gl } = this.textures;
    // three.js may have left its own ways of unpacking behind, and does not know what is done behind its back.
    for (const name of ["UNPACK_FLIP_Y_WEBGL", "UNPACK_PREMULTIPLY_ALPHA_WEBGL"]) gl.pixelStorei(gl[name], false);
    for (const name of ["UNPACK_ROW_LENGTH", "UNPACK_SKIP_PIXELS", "UNPACK_SKIP_ROWS"]) gl.pixelStorei(gl[name], 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
    const whole = this.textures.take(update, deadline);
    this.renderer.resetState();
    if (!whole) return false;
    this.uploaded = this.textures.uploaded;
    const { slots, positions } = update.places;
    if (slots) slots.forEach((slot, i) => this.positions.set(positions.subarray(3 * i, 3 * i + 3), 3 * slot));
    else this.positions = positions;
    for (const name of ["geometry", "colours"]) {
      const { texture } = this.textures[name];
      if (this[name].value.sourceTexture === texture) continue;
      this[name].value = new THREE.ExternalTexture(texture);
      this[name].uniform.value = this[name].value;
    }
    this.background = update.background;
    this.changed = true;
    return true;
  }

  draw() {
    // three.js draws.
  }

  dispose() {
    this.textures.dispose();
  }

  // What Spark asks of a source.

  prepareFetchSplat() {}

  getNumSplats() {
    return this.textures.used;
  }

  hasRgbDir() {
    return Math.min(this.getNumSh(), this.most) > 0;
  }

  getNumSh() {
    return Math.max(this.textures.degree, 0);
  }

  setMaxSh(most) {
    this.most = most;
  }

  fetchSplat({ index, viewOrigin }) {
    const degree = viewOrigin ? this.getNumSh() : 0;
    const texels = colourTexels(this.getNumSh());
    const [lines, colourLines] = [GEOMETRY_TEXELS, texels].map(shiftOf);
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

  /** Of each splat its centre alone, which is what boxes are made of; the rest is in the graphics. */
  forEachSplat(callback) {
    const { positions } = this;
    for (let slot = 0; slot < this.getNumSplats(); slot += 1) {
      const center = new THREE.Vector3(...positions.subarray(3 * slot, 3 * slot + 3));
      if (Number.isNaN(center.x)) continue;
      callback(slot, center, new THREE.Vector3(), new THREE.Quaternion(), 1, new THREE.Color());
    }
  }

  /** Whether anything changed since the last call. */
  flush() {
    const { changed } = this;
    this.changed = false;
    return changed;
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

  /** Tell Spark what changed since the last picture. */
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
      new THREE.Vector3(...this.player.pivot.up),
      new THREE.Vector3(0, 1, 0),
    );
  }

  /** Put a PerspectiveCamera where the player's view is, as far as such a camera can show its picture. */
  place(camera) {
    const { view } = this.player;
    const [x, y, z] = [view.right, view.down.map((v) => -v), view.forward.map((v) => -v)];
    const basis = new THREE.Matrix4().makeBasis(...[x, y, z].map((axis) => new THREE.Vector3(...axis)));
    basis.setPosition(...view.eye).premultiply(this.mesh.matrixWorld);
    basis.decompose(camera.position, camera.quaternion, new THREE.Vector3());
    const { width, height } = this.source.renderer.domElement;
    const { fx, fy, cx, cy } = cameraOf(view, width, height);
    Object.assign(camera, { aspect: width / height, fov: (360 / Math.PI) * Math.atan(height / (2 * fy)) });
    camera.updateProjectionMatrix();
    // The middle of the view need not be that of its picture, nor its pixels be square.
    const matrix = camera.projectionMatrix;
    matrix.elements[0] = (2 * fx) / width;
    matrix.elements[8] = 1 - (2 * cx) / width;
    matrix.elements[9] = (2 * cy) / height - 1;
    camera.projectionMatrixInverse.copy(matrix).invert();
  }

  dispose() {
    this.player.dispose();
    this.mesh.dispose();
  }
}
