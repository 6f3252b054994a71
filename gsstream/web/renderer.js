// Draws a scene with WebGL2 from float32 textures, in the depth order that a worker finds.

import { ResidentScene } from "./resident.js";
import { COPY_FRAGMENT_SHADER, COPY_VERTEX_SHADER } from "./shaders.js";
import { SortQueue } from "./sort-queue.js";
import { Projection, Quads, link } from "./splats.js";

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
      onChange();
    });
  }

  /** Take note of what the packet just decoded into `state` changed. Call it once for every packet. */
  update(state) {
    this.state = state;
    this.background = state.meta.background;
    const { anew, moved } = this.scene.update(state);
    if (anew) {
      this.sorter.reset(this.scene.capacity);
      this._moved.clear();
    }
    for (const slot of moved) this._moved.add(slot);
  }

  /**
   * Draw `camera` at the size of the canvas. With `exact` the order is found here and now. Otherwise it may be that of
   * the picture before; while there is none, or with `patient` while the worker sorts, nothing is drawn. Returns
   * whether it drew.
   */
  draw(camera, { exact = false, patient = false } = {}) {
    if (!this.state || this.gl.isContextLost()) return false;
    const { sorter, scene } = this;
    this._sendPositions();
    const axis = Array.from(camera.viewmat.slice(8, 12));
    if (exact) sorter.sortNow(axis, camera.near, scene.slots.slotOf);
    else sorter.request(axis, camera.near);
    // While the worker sorts.
    this.projection.fit(scene.textures);
    this.uploaded = scene.textures.flush();
    if (!exact && sorter.busy && (patient || !sorter.order.length)) return false;
    this._fitTarget();
    this.projection.update(this.scene.textures, camera, this.canvas, this.marks ? this.state.frame : -1);
    this._drawSplats();
    this._copyToCanvas();
    return true;
  }

  dispose() {
    this.sorter.dispose();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  _setUp() {
    const { gl } = this;
    // Hundreds of layers are blended into one pixel: eight bits would round each of them.
    const floats = gl.getExtension("EXT_color_buffer_float");
    this.deep = Boolean(floats || gl.getExtension("EXT_color_buffer_half_float"));
    // A processor that has to draw takes as long to convert halves as for all the rest.
    const software = /swiftshader|llvmpipe|software/i.test(rendererOf(gl));
    this.format = software && floats && gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F;
    this.projection = new Projection(gl);
    this.quads = new Quads(gl);
    this.copy = link(gl, COPY_VERTEX_SHADER, COPY_FRAGMENT_SHADER);
    this.target = null;
    this.plain = gl.createVertexArray();
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  _sendPositions() {
    if (!this._moved.size) return;
    const slots = Uint32Array.from(this._moved);
    const positions = new Float32Array(3 * slots.length);
    const { rowOf } = this.scene.slots;
    const { means } = this.state.scene;
    for (let i = 0; i < positions.length; i += 1) {
      const row = rowOf[slots[Math.floor(i / 3)]];
      positions[i] = row >= 0 ? means[3 * row + (i % 3)] : NaN;
    }
    this._moved.clear();
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
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, canvas.width, canvas.height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, buffer, width: canvas.width, height: canvas.height };
  }

  _drawSplats() {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target ? this.target.buffer : null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.quads.draw(this.sorter.order, this.projection, canvas);
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

/** What draws, in the words of the browser. */
function rendererOf(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}
