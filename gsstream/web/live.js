// A stream as it is written: packets from a socket, decoded when they come, the newest one shown.

import "./changes/field.js";
import "./changes/light.js";
import { FILE_HEADER, KIND, PACKET_HEADER, checkFileHeader, parseHeader } from "./container.js";
import { PacketError } from "./errors.js";
import { LiveParts } from "./live-parts.js";
import { LiveSocket } from "./live-socket.js";

/** Milliseconds of decoding after which what there is is shown, although more has come. */
const CATCH_UP = 250;
/** Milliseconds without a frame of which the viewer is told; longer where frames come seldom. */
export const settings = { quiet: 10_000 };

/** Stands where a recording has its buffer (see buffer.js); the stream calls `feed` when the page can show more. */
export class LiveBuffer {
  constructor(url, stream, parts) {
    Object.assign(this, { url, stream, live: true, fps: 30, received: 0, first: null, last: null, lastLoaded: null });
    Object.assign(this, { queue: [], waiting: 0, gaps: [], told: "" });
    /** Bytes that may wait to be decoded. A page that is not shown takes no more and catches up later. */
    this.most = 16 * 2 ** 20;
    this.state = { name: "live", detail: "" };
    this.cut = this.broken = this.joined = this.before = null;
    this.socket = parts ? new LiveParts(this) : new LiveSocket(this);
    this.clock = setInterval(() => this._tell(), 500);
    this.socket.start();
  }

  /** Seconds of playing that wait; a live stream is shown at once. */
  secondsAfter() {
    return this.queue.length / this.fps;
  }

  /** Take packets again after `pause`, or after an error. */
  resume() {
    this.asleep = false;
    this.at = null;
    this.told = "";
    this.socket.start();
  }

  /** Take no more packets; what comes meanwhile is caught up with later. */
  pause() {
    this.cut = null;
    this.socket.stop();
    this._tell();
  }

  dispose() {
    clearInterval(this.clock);
    this.socket.stop();
  }

  /** What only recordings have: parts to load, and a part after a damaged one. */
  want() {}

  nextSegment() {
    return null;
  }

  /** Decode what came. The newest state is shown; of those before it none is, unless decoding takes long. */
  feed() {
    const { stream } = this;
    if (!stream.playing || !stream.hungry) return;
    if (this.asleep && !this.queue.length) this.resume();
    const started = performance.now();
    let decoded = false;
    while (this.queue.length && performance.now() - started < CATCH_UP) {
      const packet = this.queue.shift();
      this.waiting -= packet.data.length;
      decoded = this._decode(packet) || decoded;
    }
    this._tell();
    if (decoded) stream.sendFrame();
  }

  _decode(packet) {
    if (this.broken && packet.header.kind !== KIND.key) return false;
    try {
      this.stream.take({ packet });
      this.broken = null;
      return true;
    } catch (error) {
      if (!(error instanceof PacketError)) {
        this.stream.fail(error);
        return false;
      }
      this.broken = `${error.message}; the picture stands still until the next key packet.`;
      return false;
    }
  }

  // What the socket asks and says.

  /** Where to connect. Whoever comes again says what it has, and gets only what follows that. */
  address() {
    const url = new URL(this.url);
    if (/^https?:$/.test(url.protocol)) url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    if (this.before && !this.broken) {
      url.searchParams.set("after", this.before.frame);
      url.searchParams.set("packet", this.before.head);
    }
    return url.href;
  }

  opened() {
    this.joined ??= Date.now();
    this.begun = false;
    this.at = null;
  }

  /** There is no connection, and why. */
  trouble(sentence) {
    this.cut = sentence;
    this._tell();
  }

  /** Whether the stream has ended, so that a connection that breaks is not missed. */
  get over() {
    return this.state.name === "ended" && !this.broken;
  }

  /** The server says how the stream is, or when it wrote a packet: this clock is behind the server's. */
  said({ state, detail, frame, written }) {
    const { ahead } = this.socket;
    if (state !== undefined) {
      this.state = { name: state, detail: String(detail ?? "") };
      this.cut = null;
      this._tell();
    } else if (Number.isFinite(written)) {
      this.stream.say({ written: { frame, written, came: Date.now() + ahead, ahead, joined: this.joined + ahead } });
    }
  }

  /** The header of the stream, or a packet. */
  came(bytes) {
    this.received += bytes.length;
    try {
      if (!this.begun || bytes[0] === 0x89) this._begin(bytes);
      else this._packet(bytes);
    } catch (error) {
      this._refuse(error);
    }
  }

  /** The header of a stream. A second one on a connection: another stream begins. */
  _begin(bytes) {
    checkFileHeader(bytes.subarray(0, FILE_HEADER));
    if (this.begun) this.before = null;
    this.begun = true;
  }

  _packet(data) {
    const header = parseHeader(data, 0);
    if (data.length !== PACKET_HEADER + header.body) {
      throw new PacketError("the server sends something that is no stream");
    }
    if (header.kind !== KIND.key && header.frame !== (this.before?.frame ?? NaN) + 1) {
      throw new PacketError(`the server sends frame ${header.frame} without the one before it`);
    }
    // What lies before a key packet need not be decoded any more.
    if (header.kind === KIND.key) this._forget();
    this.first ??= header.frame;
    this.lastLoaded = header.frame;
    this.before = { frame: header.frame, head: hex(data.subarray(0, PACKET_HEADER)) };
    this.queue.push({ data, offset: 0, header });
    this.waiting += data.length;
    this.cut = null;
    this.socket.sound();
    this._timed();
    this.feed();
    if (this.waiting > this.most && this.queue.length > 1) {
      this.asleep = true;
      this.socket.stop();
    }
  }

  _forget() {
    this.queue = [];
    this.waiting = 0;
  }

  /** What cannot be read is no stream for this player: a newer format will not become older by waiting. */
  _refuse(error) {
    this._forget();
    this.before = null;
    if (this.begun) {
      this.socket.again(sentence(error.message));
      return;
    }
    this.socket.stop();
    this.stream.fail(new PacketError(error.message));
  }

  _timed() {
    const now = performance.now();
    if (this.at) this.gaps = [...this.gaps.slice(-9), now - this.at];
    this.at = now;
  }

  _sentence() {
    if (this.cut) return this.cut;
    if (this.broken) return sentence(this.broken);
    const { name, detail } = this.state;
    if (name === "ended") return "The stream has ended.";
    if (name !== "live") return sentence(detail || "no frame is encoded yet.");
    const silence = this.at ? performance.now() - this.at : 0;
    if (!this.stream.playing || silence < Math.max(settings.quiet, 3 * Math.max(0, ...this.gaps))) return "";
    return `No new frame came for ${Math.floor(silence / 1000)} s.`;
  }

  _tell() {
    const text = this._sentence();
    if (text === this.told) return;
    this.told = text;
    this.stream.say({ problem: text, ended: false });
  }
}

function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function hex(bytes) {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
