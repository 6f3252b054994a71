// Plays a stream on a canvas: keeps time, asks for frames, and draws from where the viewer looks. Loading and decoding
// are done elsewhere (see stream.js); nothing of a packet comes here.

import { cameraOf, pivotOf, viewsOf } from "./camera.js";
import { Renderer } from "./renderer.js";
import { regionOf } from "./region.js";
import { StreamLink } from "./stream-link.js";

/** Milliseconds of a turn in which what came is handed to the graphics; of the first, while there is nothing to see. */
const UPLOAD = 4;
const FIRST_UPLOAD = 12;
/** Seconds of playing that may be left out at once when frames come late. */
const LATE = 0.25;

/**
 * `options.renderer` takes the place of the player's own; it has `take(update, deadline)` (see Renderer),
 * `draw(camera, options)` and `dispose()`. `options.worker` false decodes on the page's thread.
 *
 * `state` is `{ frame, number, meta }` of the frame that is shown; `number` counts Gaussians.
 *
 * Events: `opened` (what there is to load is known), `ready` (the first picture can be drawn), `drawn` (it is), `frame`,
 * `state` (playing, waiting, paused, ended), `problem` (detail: a sentence), `view`.
 */
export class Player extends EventTarget {
  constructor(canvas, options = {}) {
    super();
    this.canvas = canvas;
    this.options = options;
    const onChange = () => this.invalidate();
    const useWorker = options.worker !== false;
    const onLost = () => this.link.post("whole");
    this.renderer = options.renderer ?? new Renderer(canvas, { onChange, onLost, useWorker });
    this.loop = options.loop ?? true;
    this.speed = options.speed ?? 1;
    this.playing = false;
    this.view = this.pivot = this.region = null;
    this.views = [];
    this.statistics = { drawn: 0, decode: 0, bytes: 0, uploaded: 0 };
    /** What draws in the place of the canvas, and calls `turn` for every picture: a headset. */
    this.driver = null;
    this._number = this._serial = this._clock = this._taken = 0;
    this._then = null;
    this._dirty = this._closed = this.drew = false;
    this._reset();
    this.link = new StreamLink((message) => this._hear(message), { allowed: useWorker, early: options.early });
    this._tick = (now) => this._turn(now);
    requestAnimationFrame(this._tick);
  }

  /** Open a stream; resolves when its first frame is there. Rejects with an Error of one sentence. */
  open(url) {
    const { href } = new URL(url, document.baseURI);
    const { early } = this.options;
    const told = this._number === 0 && early?.worker && !early.failed;
    const heard = this._unheard;
    this.close();
    this._number += told && early.url !== href ? 2 : 1;
    if (told && early.url === href) {
      // It was asked for before this module was there.
      this.link.sent?.push(["open", 1, href]);
      for (const message of heard) this._hear(message);
    } else {
      this.link.post("open", this._number, href);
    }
    return this._opening();
  }

  /** Go on with another rendition of the recording, from the key packet before the frame that is shown. */
  choose(index) {
    const { frame } = this;
    this._came = [];
    this.state = null;
    this._target = frame;
    this._number += 1;
    this._serial += 1;
    this.link.post("choose", this._number, index, frame, this._serial);
    return this._opening();
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
    if (this.problem) this.link.post("retry");
    this.problem = null;
    this.playing = true;
    this._clock = 0;
    this.link.post("play", true);
    this._say("state");
  }

  pause() {
    this.playing = false;
    this.link.post("play", false);
    this._say("state");
  }

  /** Show a frame as soon as it is there. A live stream only shows its newest. */
  seek(frame) {
    if (this.buffer?.live) return;
    this._ask(Math.max(this.first, Math.min(Math.round(frame), this.buffer?.last ?? Infinity)));
    this._seeking = true;
    this._clock = 0;
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

  /** A copy of the Gaussians of the frame decoded last: `{ frame, number, widths, means, quats, ... }`, or null. */
  scene() {
    return new Promise((resolve) => {
      this._scenes.push(resolve);
      this.link.post("scene");
    });
  }

  /** Draw now. `exact` finds the depth order first; else it may be that of before, and then `patient` draws nothing. */
  draw(options = {}) {
    if (!this.state || !this.view) return false;
    if (this.renderer.draw(cameraOf(this.view, this.canvas.width, this.canvas.height), options) === false) return false;
    this.shown();
    return true;
  }

  /** A picture of the state was drawn. */
  shown() {
    this.statistics.drawn += 1;
    if (!this.drew) {
      this.drew = true;
      this._say("drawn");
    }
    this.latency?.shown(this.frame, Date.now());
  }

  close() {
    if (this.buffer || this._opened) this.link.post("close");
    this._opened?.reject(new DOMException("the player is closed", "AbortError"));
    this._reset();
  }

  dispose() {
    this._closed = true;
    this.close();
    this.link.dispose();
    this.renderer.dispose();
  }

  /** What is done for every picture but drawing it. */
  turn(now) {
    const seconds = this._then === null ? 0 : Math.min((now - this._then) / 1000, 0.25);
    this._then = now;
    this.options.beforeFrame?.(seconds);
    this._take(performance.now() + (this.drew ? UPLOAD : FIRST_UPLOAD));
    if (!this.buffer?.live) this._advance(seconds);
  }

  _turn(now) {
    if (this._closed) return;
    requestAnimationFrame(this._tick);
    if (this.driver) return;
    this.turn(now);
    if (!this._dirty) return;
    if (this.state) {
      this._dirty = false;
      // It waits once: frames may come faster than orders.
      this._taken = this.draw({ patient: this._taken > 1 }) ? 0 : -Infinity;
    } else if (this._glimpse) {
      const { view, number } = this._glimpse;
      this._dirty = false;
      if (this.renderer.draw(cameraOf(view, this.canvas.width, this.canvas.height)) !== false)
        this.statistics.early = number;
    }
  }

  _reset() {
    this.source = this.buffer = this.state = this.view = this.problem = this.latency = null;
    this._target = this._opened = this._glimpse = this._meta = null;
    this._came = [];
    this._unheard = [];
    this._scenes = [];
    this._seeking = this.drew = false;
  }

  _opening() {
    this._opened?.reject(new DOMException("another stream is opened", "AbortError"));
    return new Promise((resolve, reject) => {
      this._opened = { resolve, reject };
    });
  }

  /** A message of the stream. */
  _hear(message) {
    if (this._number === 0) this._unheard.push(message);
    if (this._closed || (message.number ?? this._number) !== this._number) return;
    const { loaded, opened, frame, early, written } = message;
    if (loaded) this.buffer = { ...this.buffer, ...loaded };
    if (opened) this._begin(opened);
    if (frame || early) this._came.push(frame ?? early);
    if (frame) this.buffer = { ...this.buffer, ...frame.loaded };
    if ("problem" in message) this._stop(message);
    if ("scene" in message) this._scenes.shift()?.(message.scene);
    if (written) this.latency?.written(written);
  }

  async _begin(opened) {
    this.source = opened;
    if (opened.live) {
      this.playing = true;
      this.link.post("feed");
    }
    this._say("opened");
    if (!opened.live) return;
    const { Latency } = await import("./latency.js");
    if (this.source === opened) this.latency = new Latency();
  }

  /** Hand what came to the graphics, until the deadline. */
  _take(deadline) {
    while (this._came.length) {
      const [update] = this._came;
      try {
        if (!this.renderer.take(update, deadline)) return;
      } catch (error) {
        this._came = [];
        this._stop({ problem: error.message, kind: error.name, ended: true });
        return;
      }
      this._came.shift();
      this.statistics.uploaded += this.renderer.uploaded ?? 0;
      this._meta = update.meta ?? this._meta;
      if (update.loaded) this._frame(update);
      else this._early(update);
      if (performance.now() >= deadline) return;
    }
  }

  _frame({ frame, gaussians, packets, key, statistics, serial }) {
    this.state = { frame, number: gaussians, meta: this._meta };
    Object.assign(this.statistics, statistics, { key });
    // After a jump, of more than one packet or to a key packet, the order of before is far from right.
    this._taken += packets + key;
    if (this.view === null) this._ready();
    if (serial === this._serial) this._target = null;
    if (this._target === null) this._seeking = false;
    if (this.buffer.live) this.link.post("feed");
    this._opened?.resolve();
    this._opened = null;
    this.invalidate();
    this._say("frame");
  }

  _early({ gaussians }) {
    const view = this._firstView();
    if (this.state || !view) return;
    this._glimpse = { view, number: gaussians };
    this.invalidate();
  }

  /** Let the clock run and ask for the frame that it says. */
  _advance(seconds) {
    if (!this.playing || !this.state || this._seeking) return;
    const pace = this.fps * this.speed;
    this._clock = Math.min(this._clock + seconds * pace, Math.max(1, LATE * pace));
    if (this._target !== null || this._clock < 1) return;
    const step = Math.floor(this._clock);
    this._clock -= step;
    const next = this.frame + step;
    const { last } = this.buffer;
    if (last === null || next <= last) this._ask(next);
    else if (this.frame < last) this._ask(last);
    else if (this.loop && last > this.first) this._ask(this.first);
    else this.pause();
  }

  _ask(frame) {
    this._target = frame;
    this._serial += 1;
    this.link.post("to", frame, this._serial);
  }

  _firstView() {
    this.views = viewsOf(this._meta);
    return this.views.find(({ id }) => id === this.options.camera) ?? this.views[0];
  }

  _ready() {
    const view = this._firstView();
    if (!view) {
      this._stop({ problem: "The stream names no camera to look from.", kind: "Error", ended: true });
      this.state = null;
      return;
    }
    this.look(this.views.indexOf(view));
    this._say("ready");
  }

  /** Something is wrong. What cannot be gone on with ends the playing. */
  _stop({ problem, kind, ended }) {
    this.problem = problem || null;
    if (ended) {
      this.playing = false;
      this._target = null;
      this._seeking = false;
    }
    if (problem && kind) {
      this._opened?.reject(Object.assign(new Error(problem), { name: kind }));
      this._opened = null;
    }
    this.dispatchEvent(new CustomEvent("problem", { detail: problem }));
    this._say("state");
  }

  _say(name) {
    this.dispatchEvent(new Event(name));
  }
}
