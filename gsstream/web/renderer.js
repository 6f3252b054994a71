// Draws a scene with WebGL2 from float32 textures, in the depth order that a worker finds.

import { SceneTextures, plainTexture } from "./scene-textures.js";
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
   * Draw on `canvas`. `onChange` is called when a new order has come and a picture should be drawn, `onLost` when the
   * graphics forgot the scene. Throws an Error in plain words when the browser offers no WebGL2.
   */
  constructor(canvas, { onChange = () => {}, onLost = () => {}, useWorker = true } = {}) {
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
    this.sorter = new SortQueue(onChange, useWorker);
    /** The slot of each row, null while they are the same. */
    this.list = null;
    this._setUp();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this._setUp();
      onLost();
    });
  }

  /**
   * Take what Packer packed, `{ frame, background, ... }`, until `deadline` (of performance.now). Returns whether all of
   * it is there; call it again with the same until it is. Of a lost context nothing is there, and nothing is waited for.
   */
  take(update, deadline) {
    this.uploaded = 0;
    // After a loss only all of a scene is of use.
    const usable = this.textures.geometry || update.textures.geometry.all;
    if (usable && !this.gl.isContextLost()) {
      // While it uploads what nothing is drawn with yet.
      if (this.frame === null) this.projection.compile(update.degree);
      if (!this.textures.take(update, deadline)) return false;
      this.uploaded = this.textures.uploaded;
      this.frame = update.frame;
    }
    const { anew, slots, positions } = update.places;
    if (anew || slots.length) this.sorter.update(slots, positions);
    if (update.list !== undefined) this.list = update.list;
    this.background = update.background;
    return true;
  }

  /**
   * Draw `camera` at the size of the canvas. With `exact` the order is found here and now. Otherwise it may be that of
   * the picture before; while there is none, or with `patient` while the worker sorts, nothing is drawn. Returns
   * whether it drew.
   */
  draw(camera, { exact = false, patient = false } = {}) {
    if (!this.prepare(camera, exact)) return false;
    if (!exact && this.sorter.busy && (patient || !this.sorter.order.length)) return false;
    const { width, height } = this.canvas;
    this.paint(camera, { framebuffer: null, x: 0, y: 0, width, height });
    return true;
  }

  /** Ask for the depth order of a view, or find it if `exact`. Returns whether there is anything to draw. */
  prepare({ viewmat, near }, exact = false) {
    if (this.frame === null || this.gl.isContextLost()) return false;
    const axis = Array.from(viewmat.slice(8, 12));
    if (exact) this.sorter.sortNow(axis, near, this.list);
    else this.sorter.request(axis, near);
    // While the worker sorts.
    this.projection.fit(this.textures);
    return true;
  }

  /** Draw a view into a window of a framebuffer, in the order that is there; `shown`: the share that is left of a fade. */
  paint(camera, { framebuffer, x, y, width, height }, shown = 1) {
    const { gl } = this;
    this._fitTarget(width, height);
    this.projection.update(this.textures, camera, { width, height }, this.marks ? this.frame : -1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.quads.draw(this.sorter.order, this.projection, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(x, y, width, height);
    gl.useProgram(this.copy.handle);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(this.copy.at("picture"), 0);
    gl.uniform2i(this.copy.at("corner"), x, y);
    gl.uniform1f(this.copy.at("shown"), shown);
    gl.bindVertexArray(this.plain);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  dispose() {
    this.sorter.dispose();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  _setUp() {
    const { gl } = this;
    this.textures = new SceneTextures(gl);
    /** The frame that is there. */
    this.frame = null;
    // Hundreds of layers are blended into one pixel: eight bits would round each of them.
    const floats = gl.getExtension("EXT_color_buffer_float");
    const deep = floats || gl.getExtension("EXT_color_buffer_half_float");
    // A processor that has to draw takes as long to convert halves as for all the rest.
    const software = /swiftshader|llvmpipe|software/i.test(rendererOf(gl));
    const whole = software && floats && gl.getExtension("EXT_float_blend");
    this.format = whole ? gl.RGBA32F : deep ? gl.RGBA16F : gl.RGBA8;
    this.projection = new Projection(gl);
    this.quads = new Quads(gl);
    this.copy = link(gl, COPY_VERTEX_SHADER, COPY_FRAGMENT_SHADER);
    this.target = null;
    this.plain = gl.createVertexArray();
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  _fitTarget(width, height) {
    const { gl } = this;
    if (this.target?.width === width && this.target.height === height) return;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.buffer);
    }
    const texture = plainTexture(gl, this.format, width, height);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, buffer, width, height };
  }
}

/** What draws, in the words of the browser. */
function rendererOf(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}
