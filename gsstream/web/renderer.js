// Draws a scene with WebGL2 from float32 textures, in the depth order that a worker finds.

import { COPY_FRAGMENT_SHADER, COPY_VERTEX_SHADER, FRAGMENT_SHADER, vertexShader } from "./shaders.js";
import { ResidentScene } from "./resident.js";
import { SortQueue } from "./sort-queue.js";

/** Variance that every footprint gets, in pixels squared of the recording: a larger picture is not made of needles. */
const BLUR = 0.3;
/** Frames after which the mark of a change has faded to a third. */
const MARK_LASTS = 3;

/**
 * A camera is `{ viewmat, fx, fy, cx, cy, width, height, near }`: world to camera as 16 numbers row by row (x right, y
 * down, z forward), the rest in pixels with the corner of the picture as origin, near in scene units; `scale`: pixels
 * of the picture for one of the recording, 1 if left out.
 */
export class Renderer {
  /**
   * Draw on `canvas`. `onChange` is called when a new order has come and a picture should be drawn. Throws an Error in
   * plain words when the browser offers no WebGL2.
   */
  constructor(canvas, { onChange = () => {}, useWorker = true } = {}) {
    const gl = canvas.getContext("webgl2", {
      antialias: false,
      depth: false,
      alpha: false,
      powerPreference: "high-performance",
    });
    if (!gl) throw new Error("This browser offers no WebGL2, which the player draws with.");
    this.canvas = canvas;
    this.gl = gl;
    this.background = [0, 0, 0];
    this.marks = false;
    this.uploaded = 0;
    this.scene = new ResidentScene(gl);
    this.sorter = new SortQueue(onChange, useWorker);
    this.state = null;
    this._moved = new Set();
    this._setUp();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this._setUp();
      this.scene.restore(this.state);
      if (this.state) this._fitProgram();
      onChange();
    });
  }

  /** Take note of what the packet just decoded into `state` changed. Call it once for every packet. */
  update(state) {
    this.state = state;
    this.background = state.meta.background;
    const { anew, moved } = this.scene.update(state);
    this._fitProgram();
    if (anew) {
      this.sorter.reset(this.scene.capacity);
      this._moved = new Set(moved);
    } else {
      for (const slot of moved) this._moved.add(slot);
    }
  }

  /** Draw `camera` at the size of the canvas. With `exact` the order is found here and now. */
  draw(camera, { exact = false } = {}) {
    if (!this.state || this.gl.isContextLost()) return;
    this._sendPositions();
    this.uploaded = this.scene.textures.flush();
    const axis = Array.from(camera.viewmat.slice(8, 12));
    if (exact) this.sorter.sortNow(axis, camera.near, this.scene.slots.slotOf);
    else this.sorter.request(axis, camera.near);
    this._fitTarget();
    this._drawSplats(camera);
    this._copyToCanvas();
  }

  /** The picture last drawn as RGBA bytes, top row first. */
  readPixels() {
    const { gl } = this;
    const { width, height } = this.canvas;
    const data = new Uint8Array(width * height * 4);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    const out = new Uint8Array(data.length);
    for (let y = 0; y < height; y += 1)
      out.set(data.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
    return out;
  }

  dispose() {
    this.sorter.dispose();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  _setUp() {
    const { gl } = this;
    // Hundreds of layers are blended into one pixel: eight bits would round each of them.
    this.deep = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.program = null;
    this.degree = -1;
    this.copy = link(gl, COPY_VERTEX_SHADER, COPY_FRAGMENT_SHADER);
    this.target = null;
    this.orderBuffer = gl.createBuffer();
    this.splats = gl.createVertexArray();
    gl.bindVertexArray(this.splats);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    this.plain = gl.createVertexArray();
    this.uploadedOrder = null;
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  /** The program for the degree of colour that the scene has. */
  _fitProgram() {
    if (this.degree === this.scene.textures.degree) return;
    this.degree = this.scene.textures.degree;
    this.program = link(this.gl, vertexShader(this.degree), FRAGMENT_SHADER);
  }

  _sendPositions() {
    if (!this._moved.size) return;
    const slots = Uint32Array.from(this._moved);
    const positions = new Float32Array(3 * slots.length).fill(NaN);
    slots.forEach((slot, i) => {
      const row = this.scene.slots.rowOf[slot];
      if (row >= 0) positions.set(this.state.scene.means.subarray(3 * row, 3 * row + 3), 3 * i);
    });
    this._moved = new Set();
    this.sorter.update(slots, positions);
  }

  _fitTarget() {
    const { gl, canvas } = this;
    if (!this.deep || (this.target && this.target.width === canvas.width && this.target.height === canvas.height))
      return;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.buffer);
    }
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, canvas.width, canvas.height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, buffer, width: canvas.width, height: canvas.height };
  }

  _drawSplats(camera) {
    const { gl, program, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target ? this.target.buffer : null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program.handle);
    const m = camera.viewmat;
    const at = (name) => program.at(name);
    gl.uniformMatrix3fv(at("rotation"), true, [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    gl.uniform3f(at("translation"), m[3], m[7], m[11]);
    const eye = [0, 1, 2].map((i) => -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]));
    gl.uniform3f(at("eye"), ...eye);
    gl.uniform4f(at("intrinsics"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(at("size"), canvas.width, canvas.height);
    gl.uniform1f(at("near"), camera.near);
    gl.uniform1f(at("blur"), BLUR * Math.max(1, camera.scale ?? 1) ** 2);
    gl.uniform2f(at("marking"), this.marks ? this.state.frame : -1, MARK_LASTS);
    const { geometry, colours } = this.scene.textures;
    gl.uniform2i(at("lines"), geometry.shift, colours.shift);
    [geometry, colours].forEach(({ texture }, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at(unit ? "colours" : "geometry"), unit);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.bindVertexArray(this.splats);
    const { order } = this.sorter;
    if (order !== this.uploadedOrder) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
      gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
      this.uploadedOrder = order;
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (order.length) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
    gl.disable(gl.BLEND);
  }

  _copyToCanvas() {
    if (!this.target) return;
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy.handle);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(this.copy.at("picture"), 0);
    gl.bindVertexArray(this.plain);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

/** A program and its uniforms by name. Throws an Error with the compiler's words. */
function link(gl, vertex, fragment) {
  const handle = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(handle, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
    }
  }
  gl.linkProgram(handle);
  if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`the shaders do not fit together: ${gl.getProgramInfoLog(handle)}`);
  }
  const places = new Map();
  const at = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(handle, name));
    return places.get(name);
  };
  return { handle, at };
}
