// Loads a stream, decodes it and packs what changed for the graphics. It runs in a worker, or in slices on the page's
// own thread where a page may have no worker; it knows neither a page nor a picture.

import { KIND } from "./container.js";
import { PacketBuffer } from "./buffer.js";
import { copied, decodePacket } from "./decode.js";
import { forbidden } from "./download.js";
import { PacketError } from "./errors.js";
import { look } from "./layers.js";
import { Packer } from "./packing.js";
import { openSource } from "./source.js";

/** Milliseconds between two reports of what is loaded. */
const REPORT = 100;

/**
 * Hears `[name, ...arguments]`: `open` number url, `choose` number rendition frame serial, `to` frame serial,
 * `play` on, `feed`,
 * `retry`, `whole`, `scene`, `close`. Says objects with the `number` under which the stream was opened, one of:
 * `opened`; `frame` (what Packer packed, and `frame`, `gaussians`, `packets` and `key`: how many were decoded for it,
 * and whether there was a key packet; `serial` of the request that it answers; `meta` where it is another, `loaded`, `statistics`); `early` (the
 * same of a first layer); `loaded`; `problem` (a sentence, its `kind` and whether playing has `ended`); `scene`.
 */
export class Stream {
  /** `post(message, buffers)` says a message and gives buffers away; it decodes for `budget` milliseconds, then hears. */
  constructor(post, budget) {
    Object.assign(this, { post, budget, number: 0, serial: 0, playing: false, running: false, timer: null });
    /** The states after the first key packet and the one used last. */
    this.keys = [];
    this.packer = new Packer();
    this.source = this.buffer = this.state = this.target = null;
    this.statistics = { decode: 0, bytes: 0 };
  }

  hear([name, ...rest]) {
    this[name](...rest);
  }

  async open(number, url) {
    this.close();
    Object.assign(this, { number, url });
    const abort = new AbortController();
    this.abort = abort;
    try {
      const source = await openSource(url, abort.signal);
      if (abort.signal.aborted) return;
      this.source = source;
    } catch (error) {
      const told = await forbidden(url, error).then(() => error, (reason) => reason);
      if (!abort.signal.aborted) this.fail(told);
      return;
    }
    const { renditions, frames, poster, fps, live = false } = this.source;
    const names = renditions.map(({ name, gaussians }) => ({ name, gaussians }));
    this.playing ||= live;
    this._start(this.source.segments, null);
    this.say({ opened: { live, frames, poster, fps, renditions: names }, loaded: this._loaded() });
  }

  /** Go on with another rendition of the recording, from the key packet before a frame. */
  choose(number, index, frame, serial) {
    this.buffer.dispose();
    this.state = null;
    Object.assign(this, { number, serial });
    this._start(this.source.renditions[index].segments, frame);
  }

  /** Decode up to a frame and say it. */
  to(frame, serial) {
    Object.assign(this, { target: frame, serial });
    this.buffer?.want(frame, this.frame);
    this._run();
  }

  play(on) {
    this.playing = on;
    if (on) this.buffer?.resume?.();
    else this.buffer?.pause?.();
  }

  retry() {
    this.buffer?.retry?.();
  }

  /** The page has shown what it got: of a live stream it may have more. */
  feed() {
    this.hungry = true;
    this.buffer?.feed?.();
  }

  /** The graphics forgot the scene. */
  whole() {
    if (!this.state) return;
    this.packer.whole();
    this.sendFrame();
  }

  /** Say a copy of the Gaussians of the frame that was decoded last. */
  scene() {
    const { frame, number, scene, widths } = this.state ?? {};
    this.say({ scene: this.state && { frame, number, widths, ...scene } });
  }

  close() {
    this.abort?.abort(new DOMException("the player is closed", "AbortError"));
    this.buffer?.dispose();
    this.source = this.buffer = this.state = this.target = null;
    this.playing = this.hungry = false;
  }

  get frame() {
    return this.state?.frame ?? null;
  }

  say(message, buffers = []) {
    this.post({ number: this.number, ...message }, buffers);
  }

  /** Say what is wrong. A damaged segment is left out where another one follows; anything else ends the playing. */
  fail(error) {
    const damaged = error instanceof PacketError;
    this.target = (damaged && this.playing ? this.buffer?.nextSegment(this.target) : null) ?? null;
    this.say({ problem: damaged ? this._told(error) : error.message, kind: error.name, ended: this.target === null });
  }

  /** What a PacketError means for who looks at the page, and what to do. */
  _told({ message }) {
    const { url } = this;
    if (/^not a gsstream file/.test(message)) return `${url} is ${message}. Name a stream.json or a .gss file.`;
    if (/newer|older|cannot be read|only gsstream play/.test(message)) return message.charAt(0).toUpperCase() + message.slice(1);
    return `The stream is damaged: ${message}. Copy or export ${url} again.`;
  }

  /** Decode one packet, or begin where a join says. */
  take({ packet, key, join, decode }) {
    const started = performance.now();
    if (join) {
      this.state = decode(this._keyState(key), join);
    } else if (packet.header.kind === KIND.key) {
      this.state = this._keyState(packet);
    } else {
      this.state = decodePacket(this.state, packet.data, packet.offset);
    }
    this.packets += 1;
    this.key ||= this.state.change.kind === "key";
    this.packer.update(this.state);
    this.statistics = { decode: performance.now() - started, bytes: (packet?.data ?? join).length };
  }

  /** Say the frame that is decoded. */
  sendFrame() {
    this.hungry = false;
    const { packets, key, statistics } = this;
    const serial = this.target === null ? this.serial : null;
    this._send("frame", this.state, { loaded: this._loaded(), packets, key, statistics, serial });
    this.packets = 0;
    this.key = false;
  }

  /** Say a part of the first frame while the rest is on its way. */
  sendEarly(state) {
    this.packer.update(state);
    this._send("early", state, {});
  }

  _send(name, state, more) {
    const { frame, number, meta, background = meta.background } = state;
    const { update, transfer } = this.packer.pack(state);
    const told = meta === this.meta ? undefined : meta;
    this.meta = meta;
    this.say({ [name]: { ...update, frame, gaussians: number, background, meta: told, ...more } }, transfer);
  }

  _start(segments, frame) {
    this.keys = [];
    this.packer = new Packer();
    this.meta = null;
    this.packets = 0;
    this.key = false;
    // A part of a packet may be enough for a first picture.
    const early = (walker) => this.state || look(this, walker);
    this.buffer = this.source.follow?.(this) ?? new PacketBuffer(segments, () => this._news(), early);
    this.buffer.fps = this.source.fps ?? 30;
    this.target = this.buffer.live ? null : (frame ?? this.buffer.first ?? 0);
    this.buffer.want(this.target);
  }

  _news() {
    // The first frame of a file without an index is known only now.
    const first = this.buffer?.first ?? null;
    if (this.state === null && first !== null && this.target < first) this.target = first;
    this.timer ??= setTimeout(() => {
      this.timer = null;
      if (this.buffer) this.say({ loaded: this._loaded() });
    }, REPORT);
    this._run();
  }

  /** What the page may know of the buffer. */
  _loaded() {
    const { live = false, first, last, lastLoaded, received, parts } = this.buffer;
    const seconds = this.frame === null ? 0 : this.buffer.secondsAfter(this.frame);
    return { live, first, last, lastLoaded, received, seconds, parts: parts?.length ?? 0 };
  }

  async _run() {
    if (this.running) return;
    this.running = true;
    for (let started = performance.now(); this._step();) {
      if (performance.now() - started < this.budget) continue;
      await new Promise((resolve) => setTimeout(resolve));
      started = performance.now();
    }
    this.running = false;
  }

  /** Decode one packet towards the target; returns whether to go on. */
  _step() {
    const { buffer } = this;
    if (!buffer || this.target === null) return false;
    // Where a file without an index ends is known only now.
    const target = Math.min(this.target, buffer.last ?? Infinity);
    if (this.frame === target) {
      this.target = null;
      this.sendFrame();
      return false;
    }
    let step = null;
    try {
      step = buffer.towards(target, this.frame);
      if (!step) return this._missing(target);
      this.take(step);
      this.buffer.fps = this.state.meta.fps;
    } catch (error) {
      // What is damaged was not applied. A join may be done without.
      if (!(error instanceof PacketError && buffer.spoil(target, error, Boolean(step?.join)))) this.fail(error);
    }
    return true;
  }

  /** A frame is not loaded: wait for it, or, when it will never come, say why and go on with what is sound. */
  _missing(frame) {
    const failure = this.buffer.failure(frame, this.frame);
    if (failure) this.fail(failure);
    else this.buffer.want(frame, this.frame);
    // A download that is given up for another one tells nobody.
    clearTimeout(this.again);
    this.again = setTimeout(() => this._run(), REPORT);
    return Boolean(failure);
  }

  /** The state after a key packet, decoded once for several uses. */
  _keyState(packet) {
    let known = this.keys.find((entry) => entry.packet === packet);
    if (!known) {
      known = { packet, state: decodePacket(null, packet.data, packet.offset) };
      this.keys[Math.min(this.keys.length, 1)] = known;
    }
    return copied(known.state);
  }
}
