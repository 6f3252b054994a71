// The attributes of a scene as float32 textures. The page uploads what was packed beside it, a few milliseconds at a time.

import { GEOMETRY_TEXELS, colourTexels, shiftOf } from "./texels.js";

/** A texture that is read texel by texel. */
export function plainTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

/** One texture of `texels` RGBA texels a Gaussian. */
class AttributeTexture {
  constructor(gl, texels, capacity) {
    Object.assign(this, { gl, texels, capacity, shift: shiftOf(texels) });
    const lines = capacity >> this.shift;
    if (lines > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new RangeError(`this browser's graphics cannot hold ${capacity} Gaussians`);
    }
    this.texture = plainTexture(gl, gl.RGBA32F, 2 ** this.shift * texels, lines);
  }

  /** Upload one part of what was packed; returns the bytes sent. */
  upload({ runs, data }) {
    const { gl, texels, shift } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (let i = 0, at = 0; i < runs.length; i += 2) {
      const number = runs[i + 1] - runs[i];
      const x = (runs[i] & (2 ** shift - 1)) * texels;
      const lines = Math.max(1, number >> shift);
      const width = (number / lines) * texels;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, runs[i] >> shift, width, lines, gl.RGBA, gl.FLOAT, data, at);
      at += 4 * texels * number;
    }
    return data.byteLength;
  }

  dispose() {
    this.gl.deleteTexture(this.texture);
  }
}

/** The two textures of a scene: centres, rotations, scales, opacities; and colour coefficients. */
export class SceneTextures {
  constructor(gl) {
    this.gl = gl;
    this.geometry = this.colours = this.waiting = null;
    this.degree = -1;
    this.used = this.uploaded = 0;
  }

  /**
   * Upload what Packer packed, until `deadline` (of performance.now); returns whether all of it is there. What is sent
   * anew goes into textures of its own: until it is whole, the picture is that of before.
   */
  take(update, deadline = Infinity) {
    if (this.waiting?.update !== update) this._begin(update);
    const { jobs } = this.waiting;
    while (jobs.length) {
      const { texture, part } = jobs.shift();
      this.uploaded += texture.upload(part);
      if (jobs.length && performance.now() >= deadline) return false;
    }
    for (const [name, texture] of Object.entries(this.waiting.textures)) {
      if (this[name] && this[name] !== texture) this[name].dispose();
      this[name] = texture;
    }
    this.degree = update.degree;
    this.used = update.used;
    this.waiting = null;
    return true;
  }

  dispose() {
    this._drop();
    for (const texture of [this.geometry, this.colours]) texture?.dispose();
  }

  /** Give up what was half sent. */
  _drop() {
    for (const [name, texture] of Object.entries(this.waiting?.textures ?? {})) {
      if (texture !== this[name]) texture.dispose();
    }
    this.waiting = null;
  }

  _begin(update) {
    this._drop();
    const texels = { geometry: GEOMETRY_TEXELS, colours: colourTexels(update.degree) };
    const textures = {};
    const jobs = [];
    for (const [name, { capacity, all, parts }] of Object.entries(update.textures)) {
      textures[name] = all || !this[name] ? new AttributeTexture(this.gl, texels[name], capacity) : this[name];
      jobs.push(...parts.map((part) => ({ texture: textures[name], part })));
    }
    this.waiting = { update, textures, jobs };
    this.uploaded = 0;
  }
}
