// Plays a stream on a canvas: loads, decodes, keeps time, and draws from where the viewer looks.

import { PacketBuffer } from "./buffer.js";
import { cameraOf, pivotOf, viewsOf } from "./camera.js";
import { KIND } from "./container.js";
import { Snapshots, decodePacket } from "./decode.js";
import { PacketError } from "./errors.js";
import { Renderer } from "./renderer.js";
import { regionOf } from "./region.js";
import { openSource } from "./source.js";

/** Decoding may take so many milliseconds before the page gets its turn; what lies before the target is not drawn. */
const BUDGET = 80;

/**
 * `options.renderer` takes the place of the player's own; it has `update(state)`, `draw(camera)` and `dispose()`.
 *
 * Events: `opened` (what there is to load is known), `ready` (the first picture can be drawn), `drawn` (it is), `frame`,
 * `state` (playing, waiting, paused, ended), `problem` (detail: a sentence), `view`.
 */
export class Player extends EventTarget {
  constructor(canvas, options = {}) {
    super();
    this.canvas = canvas;
    this.options = options;
    const drawing = { onChange: () => this.invalidate(), useWorker: options.worker !== false };
    this.renderer = options.renderer ?? new Renderer(canvas, drawing);
    this.loop = options.loop ?? true;
    this.speed = options.speed ?? 1;
    this.playing = false;
    this.state = null;
    this.view = this.pivot = this.region = null;
    this.views = [];
    this.buffer = this.problem = null;
    this.snapshots = new Snapshots();
    this.statistics = { drawn: 0, decode: 0, bytes: 0, uploaded: 0 };
    this._target = null;
    this._clock = this._taken = 0;
    this._then = null;
    this._dirty = this._closed = this._behind = this.drew = false;
    this._tick = (now) => this._turn(now);
    requestAnimationFrame(this._tick);
  }

  /** Open a stream; resolves when its first frame is decoded. Rejects with an Error of one sentence. */
  async open(url) {
    this.close();
    this._abort = new AbortController();
    this.source = await openSource(url, this._abort.signal);
    this._say("opened");
    await this._start(this.source.segments, null);
  }

  /** Go on with another rendition of the recording, from the key packet before the frame that is shown. */
  async choose(index) {
    const chosen = this.source.renditions[index];
    const frame = this.frame;
    this.buffer.dispose();
    this.state = null;
    await this._start(chosen.segments, frame);
  }

  _start(segments, frame) {
    this.snapshots.clear();
    // A part of a packet may be enough for a first picture.
    const early = (walker) => this.state || import("./early.js").then(({ look }) => look(this, walker), () => {});
    this.buffer = this.source.follow?.(this) ?? new PacketBuffer(segments, () => this._news(), early);
    this.buffer.fps = this.source.fps ?? 30;
    this._target = this.buffer.live ? null : (frame ?? this.buffer.first ?? 0);
    this.buffer.want(this._target);
    return new Promise((resolve, reject) => {
      this._opened = { resolve, reject };
    });
  }

  get frame() {
    return this.state?.frame ?? null;
  }

  get fps() {
    return this.state?.meta.fps ?? this.source?.fps ?? 30;
  }

  get first() {
    return this.buffer?.first ?? 0;
  }

  /** Last frame there is; of a stream without an index the last one loaded. */
  get last() {
    return this.buffer?.last ?? this.buffer?.lastLoaded ?? 0;
  }

  play() {
    if (this.playing) return;
    if (this.frame !== null && this.buffer.last !== null && this.frame >= this.last) this.seek(this.first);
    if (this.problem) this.buffer?.retry?.();
    this.problem = null;
    this.playing = true;
    this._clock = 0;
    this._say("state");
  }

  pause() {
    this.playing = false;
    this._say("state");
  }

  /** Show a frame as soon as it is there. A live stream only shows its newest. */
  seek(frame) {
    const wanted = Math.max(this.first, Math.min(Math.round(frame), this.last));
    this._target = wanted;
    this._clock = 0;
    this.buffer?.want(wanted, this.frame);
    this.invalidate();
  }

  /** Look through one of the recording's cameras. */
  look(index) {
    this.view = { ...this.views[index] };
    this.pivot = pivotOf(this.views);
    this.region = this.options.limits === false ? null : regionOf(this.views, this.pivot);
    this.moved();
  }

  moved() {
    this.invalidate();
    this._say("view");
  }

  set marks(on) {
    this.renderer.marks = on;
    this.invalidate();
  }

  get marks() {
    return this.renderer.marks;
  }

  /** Draw again at the next opportunity. */
  invalidate() {
    this._dirty = true;
  }

  /** Draw now. `exact` finds the depth order first; else it may be that of before, and then `patient` draws nothing. */
  draw(options = {}) {
    if (!this.state || !this.view) return false;
    const drew = this.renderer.draw(cameraOf(this.view, this.canvas.width, this.canvas.height), options);
    this.statistics.uploaded += this.renderer.uploaded;
    if (drew === false) return false;
    this.statistics.drawn += 1;
    if (!this.drew) {
      this.drew = true;
      this._say("drawn");
    }
    this.buffer?.shown?.(this.frame);
    return true;
  }

  close() {
    this._abort?.abort(new DOMException("the player is closed", "AbortError"));
    this.buffer?.dispose();
    this.buffer = this.state = this.view = this.problem = this._target = null;
    this.drew = false;
  }

  dispose() {
    this._closed = true;
    this.close();
    this.renderer.dispose();
  }

  _turn(now) {
    if (this._closed) return;
    requestAnimationFrame(this._tick);
    const seconds = this._then === null ? 0 : Math.min((now - this._then) / 1000, 0.25);
    this._then = now;
    this.options.beforeFrame?.(seconds);
    if (this.buffer?.live) this.buffer.feed();
    else if (this.buffer) this._advance(seconds);
    if (this._dirty && this.state && !this._behind) {
      this._dirty = false;
      // It waits once: packets may come faster than orders.
      this._taken = this.draw({ patient: this._taken > 1 }) ? 0 : -Infinity;
    }
  }

  /** Let the clock run and decode up to the frame it says. */
  _advance(seconds) {
    if (this._target === null && this.playing && this.state) {
      this._clock += seconds * this.fps * this.speed;
      if (this._clock >= 1) {
        const step = Math.floor(this._clock);
        this._clock -= step;
        this._step(step);
      }
    }
    if (this._target !== null) this._decodeTo(this._target);
  }

  _step(step) {
    const next = this.state.frame + step;
    if (this.buffer.last === null || next <= this.buffer.last) {
      this._target = next;
    } else if (this.state.frame < this.buffer.last) {
      this._target = this.buffer.last;
    } else if (this.loop && this.buffer.last > this.first) {
      this._target = this.first;
    } else {
      this.playing = false;
      this._say("state");
    }
    if (this._target !== null) this.buffer.want(this._target, this.frame);
  }

  _decodeTo(frame) {
    const started = performance.now();
    this._behind = false;
    let step = null;
    try {
      while (this.state === null || this.state.frame !== frame) {
        step = this.buffer.towards(frame, this.frame);
        if (!step) return this._missing(frame);
        this._take(step);
        if ((this._behind = performance.now() - started > BUDGET && this.state.frame !== frame)) return undefined;
      }
    } catch (error) {
      // What is damaged was not applied. A join may be done without.
      if (error instanceof PacketError && this.buffer.spoil(frame, error, Boolean(step?.join))) return undefined;
      return this._stop(error);
    }
    this._target = null;
    this.invalidate();
    this._say("frame");
    return undefined;
  }

  /** Decode one packet, or begin where a join says. */
  _take({ packet, key, join, decode }) {
    const started = performance.now();
    if (join) {
      this.state = decode(this._keyState(key), join);
    } else if (packet.header.kind === KIND.key) {
      this.state = this._keyState(packet);
    } else {
      this.state = decodePacket(this.state, packet.data, packet.offset);
    }
    this.renderer.update(this.state);
    // After a jump, of more than one packet or to a key packet, the order of before is far from right.
    this._taken += this.state.change.kind === "key" ? 2 : 1;
    this.statistics.decode = performance.now() - started;
    this.statistics.bytes = (packet?.data ?? join).length;
    this.statistics.key = this.state.change.kind === "key";
    if (this.view === null) this._ready();
    if (this._opened) {
      this._opened.resolve();
      this._opened = null;
    }
  }

  /** The state after a key packet, decoded once for several uses. */
  _keyState(packet) {
    const known = this.snapshots.get(packet);
    if (known) return known;
    const state = decodePacket(null, packet.data, packet.offset);
    this.snapshots.keep(packet, state);
    return state;
  }

  _ready() {
    this.views = viewsOf(this.state.meta);
    if (!this.views.length) throw new Error("The stream names no camera to look from.");
    const wanted = this.views.findIndex((view) => view.id === this.options.camera);
    this.look(Math.max(wanted, 0));
    this.buffer.fps = this.fps;
    this._say("ready");
  }

  /** A frame is not loaded: wait for it, or, when it will never come, say why and go on with what is sound. */
  _missing(frame) {
    const failure = this.buffer.failure(frame, this.frame);
    if (failure) this._stop(failure);
    else this.buffer.want(frame, this.frame);
  }

  /** Say what is wrong. A damaged segment is left out where another one follows; anything else ends the playing. */
  _stop(error) {
    const next = error instanceof PacketError && this.playing ? this.buffer.nextSegment(this._target) : null;
    this._target = next;
    this.playing &&= next !== null;
    this.problem = error.message;
    this._opened?.reject(error);
    this._opened = null;
    this.dispatchEvent(new CustomEvent("problem", { detail: error.message }));
    this._say("state");
  }

  _news() {
    // The first frame of a file without an index is known only now.
    const first = this.buffer?.first;
    if (this.state === null && first !== null && this._target < first) this._target = first;
  }

  _say(name) {
    this.dispatchEvent(new Event(name));
  }
}
