// Gaussians drawn in two steps: each is projected once, into textures of integers; then quads are blended, far to near.

import { plainTexture } from "./scene-textures.js";
import { COPY_VERTEX_SHADER, FRAGMENT_SHADER, VERTEX_SHADER, projectionShader } from "./shaders.js";

/** Variance that every footprint gets, in pixels squared of the recording: a larger picture is not made of needles. */
const BLUR = 0.3;
/** Frames after which the mark of a change has faded to a third. */
const MARK_LASTS = 3;

/** log2 of the entries in one line of the texture of the order. */
const SHIFT = 11;

/** The first step: every Gaussian is projected once. Where each slot lies in the picture, and how it looks. */
export class Projection {
  constructor(gl) {
    this.gl = gl;
    this.degree = -1;
    this.buffer = gl.createFramebuffer();
    this.array = gl.createVertexArray();
    this.textures = [];
    this.lines = 0;
    this.shift = 0;
  }

  /** Project `scene` for a camera and a size, after `fit`; `frame`: changes are marked as of it, or -1. */
  update(scene, camera, { width, height }, frame) {
    const { gl } = this;
    const { geometry, colours } = scene;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.viewport(0, 0, 2 ** this.shift, Math.ceil(scene.used / 2 ** this.shift));
    const { program } = this;
    gl.useProgram(program.handle);
    const m = camera.viewmat;
    const at = (name) => program.at(name);
    gl.uniformMatrix3fv(at("rotation"), true, [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    gl.uniform3f(at("translation"), m[3], m[7], m[11]);
    const eye = [0, 1, 2].map((i) => -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]));
    gl.uniform3f(at("eye"), ...eye);
    gl.uniform4f(at("intrinsics"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("near"), camera.near);
    gl.uniform1f(at("blur"), BLUR * Math.max(1, camera.scale ?? 1) ** 2);
    gl.uniform2f(at("marking"), frame, MARK_LASTS);
    gl.uniform2i(at("lines"), geometry.shift, colours.shift);
    bind(gl, program, { geometry: geometry.texture, colours: colours.texture });
    gl.bindVertexArray(this.array);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Begin to compile what scenes of a degree take. */
  compile(degree) {
    if (degree === this.degree) return;
    this.degree = degree;
    this.program = link(this.gl, COPY_VERTEX_SHADER, projectionShader(degree));
  }

  /** Make room for `scene` (SceneTextures). */
  fit({ geometry: { shift, capacity }, degree }) {
    const { gl } = this;
    this.compile(degree);
    const lines = capacity / 2 ** shift;
    if (lines === this.lines && shift === this.shift) return;
    this.textures.forEach((texture) => gl.deleteTexture(texture));
    Object.assign(this, { lines, shift });
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    const targets = [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1];
    this.textures = targets.map((target) => {
      const texture = plainTexture(gl, gl.RGBA32UI, 2 ** shift, lines);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, target, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    gl.drawBuffers(targets);
  }
}

/**
 * The second step: a quad for each Gaussian that is seen, all with one call and no instances. An instance of
 * four vertices costs what one of many does: 40 microseconds where a processor draws.
 */
export class Quads {
  constructor(gl) {
    this.gl = gl;
    this.program = link(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    this.array = gl.createVertexArray();
    this.indices = gl.createBuffer();
    this.texture = null;
    this.room = 0;
    this.order = null;
  }

  /** Draw the slots of `order` (Uint32Array) of a Projection over what is there. */
  draw(order, projection, { width, height }) {
    const { gl, program } = this;
    if (order.length > this.room) this._reserve(order.length);
    if (order !== this.order) this._send(order);
    gl.useProgram(program.handle);
    const [places, looks] = projection.textures;
    bind(gl, program, { order: this.texture, places, looks });
    gl.uniform2i(program.at("lines"), SHIFT, projection.shift);
    gl.uniform2f(program.at("size"), width, height);
    gl.bindVertexArray(this.array);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (order.length) gl.drawElements(gl.TRIANGLES, 6 * order.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
  }

  _reserve(number) {
    const { gl } = this;
    const lines = Math.ceil((1.25 * number) / 2 ** SHIFT);
    this.room = lines * 2 ** SHIFT;
    if (this.texture) gl.deleteTexture(this.texture);
    this.texture = plainTexture(gl, gl.R32UI, 2 ** SHIFT, lines);
    const indices = new Uint32Array(6 * this.room);
    for (let quad = 0, at = 0; quad < this.room; quad += 1) {
      for (const corner of [0, 1, 2, 2, 1, 3]) indices[at++] = 4 * quad + corner;
    }
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  _send(order) {
    const { gl } = this;
    this.order = order;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    const whole = order.length >> SHIFT;
    const rest = order.length - (whole << SHIFT);
    const send = (line, width, height, data) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, line, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, data);
    if (whole) send(0, 2 ** SHIFT, whole, order.subarray(0, whole << SHIFT));
    if (rest) send(whole, rest, 1, order.subarray(whole << SHIFT));
  }
}

/** A program and its uniforms by name. The page waits for the compiler only in `at`, whose Error has its words. */
export function link(gl, vertex, fragment) {
  const handle = gl.createProgram();
  const shaders = [vertex, fragment].map((text, i) => {
    const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(handle, shader);
    return shader;
  });
  gl.linkProgram(handle);
  const places = new Map();
  const at = (name) => {
    if (!places.size && !gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      const words = [gl.getProgramInfoLog(handle), ...shaders.map((shader) => gl.getShaderInfoLog(shader))];
      throw new Error(`the shaders do not compile: ${words.join(" ")}`);
    }
    if (!places.has(name)) places.set(name, gl.getUniformLocation(handle, name));
    return places.get(name);
  };
  return { handle, at };
}

/** Bind textures to units 0, 1, ... and name them to a program. */
export function bind(gl, program, textures) {
  Object.entries(textures).forEach(([name, texture], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(program.at(name), unit);
  });
  gl.activeTexture(gl.TEXTURE0);
}
