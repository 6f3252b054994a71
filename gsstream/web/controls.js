// Mouse, touch and keys move the view: orbit, pan, zoom and fly.

import { distance, looked, moved, orbited, scaleOf, zoomed } from "./camera.js";
import { outside, returned } from "./region.js";

const RADIANS_PER_PIXEL = 0.006;
/** In this time a view outside the recorded region comes back most of the way, seconds. */
const RETURN = 0.15;
const FLY = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };

/**
 * Moves `scene.view` and `scene.pivot` and calls `scene.moved()`. Listens on `canvas` and, for keys, on `keys`.
 *
 * Until a click or a tap on the canvas, or from the beginning if `eager`, the wheel and one finger scroll the page; so
 * they do again after a click elsewhere. Two fingers, and the wheel with Ctrl, zoom at any time.
 */
export class Controls {
  constructor(canvas, keys, scene, eager = false) {
    Object.assign(this, { canvas, scene, eager });
    this.pointers = new Map();
    this.held = new Set();
    this.abort = new AbortController();
    const { signal } = this.abort;
    const on = (target, name, handler, options = {}) => target.addEventListener(name, handler, { signal, ...options });
    this._take(eager);
    on(canvas, "click", () => this._take(true));
    on(globalThis, "pointerdown", (event) => event.composedPath().includes(keys) || this._take(eager));
    on(globalThis, "blur", () => this._take(eager));
    on(canvas, "contextmenu", (event) => event.preventDefault());
    on(canvas, "pointerdown", (event) => this._down(event));
    on(canvas, "pointermove", (event) => this._move(event));
    on(canvas, "pointerup", (event) => this.pointers.delete(event.pointerId));
    on(canvas, "pointercancel", (event) => this._cancel(event));
    on(canvas, "wheel", (event) => this._wheel(event), { passive: false });
    on(keys, "keydown", (event) => this._key(event, true));
    on(keys, "keyup", (event) => this._key(event, false));
    on(keys, "blur", () => this.held.clear());
  }

  dispose() {
    this.abort.abort();
  }

  /** Turn around the scene by angles in radians, and go nearer (factor below 1) or farther away. */
  turn(yaw, pitch, factor = 1) {
    const { scene } = this;
    if (scene.view) this._set(zoomed(orbited(scene.view, scene.pivot, yaw, pitch), scene.pivot, factor));
  }

  /** Fly with the keys that are held, for `seconds`, or go back into the region when nothing holds the view outside. */
  fly(seconds) {
    const { scene } = this;
    if (!scene.view) return;
    const speed = 0.6 * distance(scene.view, scene.pivot) * seconds;
    for (const key of this.held) this._shift(FLY[key].map((v) => v * speed));
    if (this.held.size || this.pointers.size || !this.outside) return;
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this._place(scene.view, still || this.outside < 0.01 ? 1 : 1 - Math.exp(-seconds / RETURN), 0);
  }

  /** 0 while the view is within the recorded region, 1 where the picture has faded. */
  get outside() {
    const { region, view, pivot } = this.scene;
    return region && view ? outside(region, view, pivot) : 0;
  }

  _take(all) {
    this.all = all;
    this.canvas.style.touchAction = all ? "none" : "pan-y";
  }

  _down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.pointers.size) this.before = { view: this.scene.view, pivot: this.scene.pivot };
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  /** The finger scrolls the page: what it moved until the browser knew is taken back. */
  _cancel(event) {
    if (this.pointers.delete(event.pointerId) && this.before.view) {
      Object.assign(this.scene, this.before);
      this.scene.moved();
    }
  }

  _move(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last || !this.scene.view) return;
    const dx = event.clientX - last.x;
    const dy = event.clientY - last.y;
    if (this.pointers.size === 2) this._pinch(event, last, dx, dy);
    else if (event.shiftKey || event.buttons & 6) this._pan(dx, dy);
    else if (event.altKey) this._set(looked(this.scene.view, this.scene.pivot, dx * 0.003, -dy * 0.003));
    else this._set(orbited(this.scene.view, this.scene.pivot, -dx * RADIANS_PER_PIXEL, -dy * RADIANS_PER_PIXEL));
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  _pinch(event, last, dx, dy) {
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
    const before = Math.hypot(last.x - other.x, last.y - other.y);
    const after = Math.hypot(event.clientX - other.x, event.clientY - other.y);
    if (after > 1) this._set(zoomed(this.scene.view, this.scene.pivot, before / after));
    this._pan(dx / 2, dy / 2);
  }

  /** What is at the pivot's distance follows the pointer. */
  _pan(dx, dy) {
    const { view, pivot } = this.scene;
    const scale = scaleOf(view, this.canvas.clientWidth, this.canvas.clientHeight);
    const size = distance(view, pivot) / (view.fx * scale);
    this._shift([-dx * size, -dy * size, 0]);
  }

  _shift(step) {
    const { view, pivot } = moved(this.scene.view, this.scene.pivot, step);
    this.scene.pivot = pivot;
    this._set(view);
  }

  /** What lies beyond the limits and the width in which the picture fades is cut off. */
  _set(view) {
    this._place(view, 1, 1);
  }

  _place(view, share, slack) {
    const { scene } = this;
    Object.assign(scene, scene.region ? returned(scene.region, view, scene.pivot, slack, share) : { view });
    scene.moved();
  }

  _wheel(event) {
    if (!this.scene.view || !(this.all || event.ctrlKey)) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    this._set(
      zoomed(this.scene.view, this.scene.pivot, Math.exp(Math.max(-1, Math.min(1, event.deltaY * lines * 0.0015)))),
    );
  }

  _key(event, down) {
    const key = event.key.toLowerCase();
    if (!FLY[key] || event.ctrlKey || event.metaKey) return;
    if (down) this.held.add(key);
    else this.held.delete(key);
    event.preventDefault();
  }
}
