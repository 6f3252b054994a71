// The attributes of a scene as float32 textures. What a frame changed is uploaded, and nothing else.

import { GEOMETRY_TEXELS, colourTexels } from "./shaders.js";

const LINE = 2048;
/** Slots that did not change but lie between two that did are uploaded too when they are at most so many. */
const GAP = 8;
/** Lines that are sent at once when everything is. */
const LINES = 32;

/** One texture of `texels` RGBA texels a Gaussian; `fill(out, start, stop)` writes 4 * texels values for each slot. */
class AttributeTexture {
  constructor(gl, texels, fill) {
    Object.assign(this, { gl, texels, fill, capacity: 0, texture: null });
    this.shift = Math.floor(Math.log2(LINE / texels));
    this.dirty = new Uint8Array(0);
    this.list = [];
    this.all = false;
  }

  /** Make room for `capacity` slots; the content is lost. Returns whether the texture is new. */
  reserve(capacity) {
    if (capacity <= this.capacity) return false;
    const { gl } = this;
    const lines = Math.ceil(capacity / 2 ** this.shift);
    if (lines > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new RangeError(`this browser's graphics cannot hold ${capacity} Gaussians`);
    }
    if (this.texture) gl.deleteTexture(this.texture);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, 2 ** this.shift * this.texels, lines);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    this.capacity = lines * 2 ** this.shift;
    this.dirty = new Uint8Array(this.capacity);
    this.list = [];
    return true;
  }

  mark(slot) {
    if (this.dirty[slot]) return;
    this.dirty[slot] = 1;
    this.list.push(slot);
  }

  /** Upload what is marked, of `used` slots; returns the bytes sent. */
  flush(used) {
    const runs = this.all || this.list.length > used / 2 ? this._lines(used) : this._runs();
    const { gl, texels, shift } = this;
    let bytes = 0;
    if (runs.length) gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const [start, stop] of runs) {
      const number = stop - start;
      const data = new Float32Array(number * texels * 4);
      this.fill(data, start, stop);
      const x = (start & (2 ** shift - 1)) * texels;
      const lines = Math.max(1, number >> shift);
      const width = (number / lines) * texels;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, start >> shift, width, lines, gl.RGBA, gl.FLOAT, data);
      bytes += data.byteLength;
    }
    for (const slot of this.list) this.dirty[slot] = 0;
    this.list = [];
    this.all = false;
    return bytes;
  }

  _lines(used) {
    const line = 2 ** this.shift;
    const stop = Math.ceil(used / line) * line;
    const runs = [];
    for (let start = 0; start < stop; start += LINES * line) runs.push([start, Math.min(start + LINES * line, stop)]);
    return runs;
  }

  _runs() {
    const slots = Uint32Array.from(this.list).sort();
    const runs = [];
    for (const slot of slots) {
      const last = runs[runs.length - 1];
      if (last && slot - last[1] < GAP && slot >> this.shift === last[0] >> this.shift) last[1] = slot + 1;
      else runs.push([slot, slot + 1]);
    }
    return runs;
  }
}

/** The two textures of a scene: centres, rotations, scales, opacities; and colour coefficients. */
export class SceneTextures {
  constructor(gl, slots) {
    this.slots = slots;
    this.gl = gl;
    this.state = null;
    this.stamps = new Float32Array(0);
    this.geometry = new AttributeTexture(gl, GEOMETRY_TEXELS, (...run) => this._fillGeometry(...run));
    this.colours = null;
    this.degree = -1;
  }

  /** Fit the textures to a state after its slots are known. Returns whether everything has to be sent again. */
  fit(state, anew) {
    this.state = state;
    const degree = Math.round(Math.sqrt(state.widths.shN / 3 + 1)) - 1;
    const { used } = this.slots;
    if (degree !== this.degree) {
      if (this.colours && this.colours.texture) this.gl.deleteTexture(this.colours.texture);
      this.colours = new AttributeTexture(this.gl, colourTexels(degree), (...run) => this._fillColours(...run));
      this.degree = degree;
    }
    const room = Math.ceil(used * 1.25) + 1;
    const grown = [this.geometry, this.colours].map((texture) => texture.capacity < used && texture.reserve(room));
    if (this.stamps.length < this.geometry.capacity) {
      const stamps = new Float32Array(this.geometry.capacity).fill(-1);
      stamps.set(this.stamps);
      this.stamps = stamps;
    }
    const all = anew || grown.includes(true);
    if (all) {
      this.geometry.all = true;
      this.colours.all = true;
    }
    return all;
  }

  /** Upload what is marked; returns the bytes sent. */
  flush() {
    return this.geometry.flush(this.slots.used) + this.colours.flush(this.slots.used);
  }

  _fillGeometry(out, start, stop) {
    const { rowOf } = this.slots;
    const { means, quats, scales, opacities } = this.state.scene;
    for (let slot = start, at = 0; slot < stop; slot += 1, at += 4 * GEOMETRY_TEXELS) {
      const row = rowOf[slot];
      if (!(row >= 0)) {
        // A dead slot: a logit that no opacity cut lets through.
        out[at + 3] = -1e9;
        continue;
      }
      for (let i = 0; i < 3; i += 1) {
        out[at + i] = means[3 * row + i];
        out[at + 8 + i] = scales[3 * row + i];
      }
      out[at + 3] = opacities[row];
      for (let i = 0; i < 4; i += 1) out[at + 4 + i] = quats[4 * row + i];
      out[at + 11] = this.stamps[slot];
    }
  }

  _fillColours(out, start, stop) {
    const { rowOf } = this.slots;
    const { sh0, shN } = this.state.scene;
    const width = this.state.widths.shN;
    const step = 4 * this.colours.texels;
    for (let slot = start, at = 0; slot < stop; slot += 1, at += step) {
      const row = rowOf[slot];
      if (!(row >= 0)) continue;
      for (let i = 0; i < 3; i += 1) out[at + i] = sh0[3 * row + i];
      for (let i = 0; i < width; i += 1) out[at + 3 + i] = shN[width * row + i];
    }
  }
}
