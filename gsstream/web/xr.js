// A headset looks into a stream: two eyes, one depth order, one decoding. Only who enters one loads this.

import { add, cross, dot, pivotOf, unit } from "./camera.js";
import { outside } from "./region.js";

/** Where eyes are above the floor, and how far away the middle of a scene is whose metres nobody knows. */
const [EYES, AWAY] = [1.6, 2];
/** What is left of the picture where no camera looked: the head is never pushed back. */
const LEFT = 0.15;
/** The least share of a window's side that is drawn where pictures come late. */
const SMALLEST = 0.6;

/**
 * The camera (see Renderer) of an XRView. `place`, a DOMMatrix, takes the stream to the space of the session; `recorded`
 * is a view of the recording.
 */
export function cameraOfView(view, { width, height }, place, recorded) {
  const metres = Math.hypot(place.m11, place.m12, place.m13);
  const seen = new DOMMatrix(Array.from(view.transform.inverse.matrix)).multiply(place);
  // The axes of a view point right, up and back.
  const columns = new DOMMatrix().scale(1 / metres, -1 / metres, -1 / metres).multiply(seen).toFloat64Array();
  const p = view.projectionMatrix;
  const fx = (p[0] * width) / 2;
  return {
    viewmat: Array.from(columns, (_, i) => columns[4 * (i % 4) + (i >> 2)]),
    near: Math.max(recorded.near, 0.05 / metres),
    scale: fx / recorded.fx,
    width,
    height,
    fx,
    fy: (p[5] * height) / 2,
    cx: (width / 2) * (1 - p[8]),
    cy: (height / 2) * (1 + p[9]),
  };
}

/** Stand where a camera of the recording stands, looking level; `metres` for one unit of the stream. */
export function placeAt({ forward, eye }, up, metres) {
  const back = unit(add(forward, up, -dot(forward, up)).map((v) => -v));
  const right = cross(up, back);
  const columns = [0, 1, 2].flatMap((k) => [right[k], up[k], back[k], 0]);
  const turn = new DOMMatrix([...columns, 0, 0, 0, 1]);
  return new DOMMatrix().translate(0, EYES, 0).scale3d(metres).multiply(turn).translate(...eye.map((v) => -v));
}

/** A place moved so that what hands held at points `from` is where they are, `to`: one hand moves, two turn and scale. */
export function grabbed(place, from, to) {
  const middle = (points) => points.reduce((sum, point) => add(sum, point, 1 / points.length), [0, 0, 0]);
  const arm = ([a, b]) => (b ? add(b, a, -1) : [1, 0, 0]);
  const [before, after] = [arm(from), arm(to)];
  const factor = Math.hypot(...after) / (Math.hypot(...before) || 1) || 1;
  const angle = Math.atan2(before[2], before[0]) - Math.atan2(after[2], after[0]);
  return new DOMMatrix()
    .translate(...middle(to))
    .rotateAxisAngle(0, 1, 0, (angle * 180) / Math.PI)
    .scale3d(factor)
    .translate(...middle(from).map((v) => -v))
    .multiply(place);
}

/** Shows what a player plays in a headset, from `enter` until the session ends. */
export class Headset {
  constructor(player) {
    Object.assign(this, { player, session: null, pictures: 0, cameras: [], held: new Map(), share: 1, exact: false });
  }

  /** Begin; call it from a click. Rejects with an Error of one sentence where the page is not let in. */
  async enter() {
    if (!isSecureContext) {
      throw new Error("A headset needs a page with https. Serve this page by https, or open it at localhost.");
    }
    const { player } = this;
    const { gl, canvas } = player.renderer;
    const wanted = { requiredFeatures: ["local-floor"] };
    const session = await navigator.xr.requestSession("immersive-vr", wanted).catch((error) => {
      throw new Error(`The headset cannot be entered: ${error.message}`);
    });
    this.session = session;
    session.addEventListener("end", () => this._ended());
    this.lost = () => session.end().catch(() => {});
    canvas.addEventListener("webglcontextlost", this.lost);
    try {
      await gl.makeXRCompatible?.();
      this.layer = new XRWebGLLayer(session, gl, { antialias: false, depth: false });
      if ("fixedFoveation" in this.layer) this.layer.fixedFoveation = 1;
      session.updateRenderState({ baseLayer: this.layer });
      this.space = await session.requestReferenceSpace("local-floor");
    } catch (error) {
      this.lost();
      throw error;
    }
    const pivot = pivotOf(player.views);
    const distance = Math.hypot(...add(player.view.eye, pivot.point, -1));
    this.place = placeAt(player.view, pivot.up, player.state.meta.metres ?? AWAY / (distance || 1));
    for (const name of ["selectstart", "squeezestart"]) {
      session.addEventListener(name, ({ inputSource }) => this.held.set(inputSource, null));
    }
    for (const name of ["selectend", "squeezeend"]) {
      session.addEventListener(name, ({ inputSource }) => this.held.delete(inputSource));
    }
    player.driver = this;
    session.requestAnimationFrame((time, frame) => this._turn(time, frame));
  }

  leave() {
    return this.session?.end();
  }

  _ended() {
    this.player.renderer.canvas.removeEventListener("webglcontextlost", this.lost);
    this.session = null;
    if (this.player.driver === this) this.player.driver = null;
    this.player.invalidate();
  }

  _turn(time, frame) {
    if (!this.session) return;
    this.session.requestAnimationFrame((next, after) => this._turn(next, after));
    const { player, layer } = this;
    player.turn(time);
    const pose = frame.getViewerPose(this.space);
    if (!pose || !player.state || player.renderer.gl.isContextLost()) return;
    this._pace(time);
    this._grab(frame);
    // A device may have one eye only: the window of the other has no size.
    const seen = pose.views.map((view) => {
      view.requestViewportScale?.(this.share);
      const { x, y, width, height } = layer.getViewport(view);
      const camera = cameraOfView(view, { width, height }, this.place, player.view);
      return { eye: view.eye, window: { framebuffer: layer.framebuffer, x, y, width, height }, camera };
    });
    this.cameras = seen.filter(({ window }) => window.width);
    this._draw(pose.transform);
    this.pictures += 1;
    this.time = time;
    this.onPicture?.(this);
  }

  _draw(head) {
    const { player, cameras } = this;
    const { renderer } = player;
    if (!cameras.length) return;
    // One order for both eyes, of the first: they stand six centimetres apart. It may be late, and is not waited for.
    if (!renderer.prepare(cameras[0].camera, this.exact || !renderer.sorter.order.length)) return;
    const shown = 1 - (1 - LEFT) * this._outside(head);
    for (const { camera, window } of cameras) renderer.paint(camera, window, shown);
    player.shown();
  }

  /** How far the head is from where cameras stood. */
  _outside({ position }) {
    const { region, view, pivot } = this.player;
    if (!region) return 0;
    const { x, y, z } = this.place.inverse().transformPoint(position);
    return outside(region, { ...view, eye: [x, y, z] }, pivot);
  }

  /** Smaller windows where pictures come late, larger ones again where they do not. */
  _pace(time) {
    const wanted = 1000 / (this.session.frameRate || 72);
    if (this.time) this.share += time - this.time > 1.5 * wanted ? -0.02 : 0.002;
    this.share = Math.min(1, Math.max(SMALLEST, this.share));
  }

  /** What hands hold moves with them. */
  _grab(frame) {
    const pairs = [];
    for (const [source, before] of this.held) {
      const pose = frame.getPose(source.gripSpace ?? source.targetRaySpace, this.space);
      if (!pose) continue;
      const { x, y, z } = pose.transform.position;
      if (before) pairs.push([before, [x, y, z]]);
      this.held.set(source, [x, y, z]);
    }
    const [from, to] = [0, 1].map((when) => pairs.slice(0, 2).map((pair) => pair[when]));
    if (from.length) this.place = grabbed(this.place, from, to);
  }
}
