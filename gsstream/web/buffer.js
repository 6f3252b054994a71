// The packets that are there, and the downloads that bring those that will be needed.

import { KIND } from "./container.js";
import { packetsOf } from "./source.js";

/** Seconds of playing that are loaded ahead. */
const AHEAD = 30;
/** Bytes of packets beyond which segments that lie far behind are forgotten. */
const MOST_BYTES = 128 * 2 ** 20;

/** Packets by frame, loaded segment by segment around the frame that is played. `onNews` is called for every packet. */
export class PacketBuffer {
  constructor(segments, onNews) {
    this.parts = segments.map((segment) => ({ segment, state: "absent", packets: [], bytes: 0, error: null }));
    this.onNews = onNews;
    this.received = 0;
    this.fps = 30;
    this.frame = null;
    this.loading = null;
  }

  /** First frame there is, or null while that is not known. */
  get first() {
    const [part] = this.parts;
    return part.segment.first ?? part.packets[0]?.header.frame ?? null;
  }

  /** Last frame there is or will be; null while only downloading tells. */
  get last() {
    const part = this.parts[this.parts.length - 1];
    if (part.segment.last !== null) return part.segment.last;
    return part.state === "done" || part.state === "failed" ? this.lastLoaded : null;
  }

  /** Last frame of the last segment that has any packet. */
  get lastLoaded() {
    const part = this.parts.findLast((p) => p.packets.length);
    return part ? part.packets[part.packets.length - 1].header.frame : null;
  }

  /** The packet of a frame, or undefined. */
  packet(frame) {
    const part = this._part(frame);
    return part?.packets[frame - part.packets[0]?.header.frame];
  }

  /** Frame of the nearest key packet at or before `frame`, or null while it is not loaded. */
  keyOf(frame) {
    const part = this._part(frame);
    const start = part?.packets[0]?.header.frame;
    if (start === undefined) return null;
    for (let i = Math.min(frame - start, part.packets.length - 1); i >= 0; i -= 1) {
      if (part.packets[i].header.kind === KIND.key) return part.packets[i].header.frame;
    }
    return null;
  }

  /** Why a frame will not come: the error that ended its segment, or null while it may still come. */
  failure(frame) {
    const part = this._part(frame);
    if (!part || part.state === "absent" || part.state === "loading") return null;
    return part.error ?? new Error("The stream is cut short here.");
  }

  /** First frame of the segment after that of `frame`, or null. */
  nextSegment(frame) {
    const part = this.parts[this.parts.indexOf(this._part(frame)) + 1];
    return part ? part.segment.first : null;
  }

  /** Seconds loaded without a gap from `frame` on. */
  secondsAfter(frame) {
    let end = frame;
    for (let part = this._part(frame); part; part = this._part(end + 1)) {
      const last = part.packets[part.packets.length - 1]?.header.frame;
      if (last === undefined || last < end || (part.state !== "done" && last <= end)) break;
      end = last;
      if (part.state !== "done" || end + 1 > (this.last ?? end)) break;
    }
    return Math.max(0, (end - frame) / this.fps);
  }

  /** Load what `frame` and the seconds after it need. A download that is not needed now is given up. */
  want(frame) {
    this.frame = frame;
    const part = this._wanted(frame);
    if (
      this.loading &&
      this.loading.part !== part &&
      this._part(frame) !== this.loading.part &&
      part === this._part(frame)
    ) {
      this.loading.abort.abort(new DOMException("another part is needed", "AbortError"));
      this.loading = null;
    }
    if (part && !this.loading) this._load(part);
  }

  /** Try the segments again that failed. */
  retry() {
    for (const part of this.parts) if (part.state === "failed") this._forget(part);
  }

  dispose() {
    this.loading?.abort.abort(new DOMException("the player is closed", "AbortError"));
  }

  _part(frame) {
    if (this.parts.length === 1) return this.parts[0];
    return this.parts.find(({ segment }) => segment.first <= frame && frame <= segment.last);
  }

  _wanted(frame) {
    const own = this._part(frame) ?? this.parts[0];
    if (own.state === "absent") return own;
    for (let i = this.parts.indexOf(own) + 1; i < this.parts.length; i += 1) {
      const part = this.parts[i];
      if ((part.segment.first - frame) / this.fps > AHEAD) return null;
      if (part.state === "absent") return part;
    }
    return null;
  }

  async _load(part) {
    const abort = new AbortController();
    this.loading = { part, abort };
    this._forget(part);
    part.state = "loading";
    try {
      for await (const packet of packetsOf(part.segment, abort.signal)) {
        if (packet.header.kind === KIND.index) continue;
        part.packets.push(packet);
        part.bytes += packet.data.length;
        this.received += packet.data.length;
        this.onNews();
      }
      part.state = "done";
    } catch (error) {
      if (abort.signal.aborted) {
        this._forget(part);
        return;
      }
      part.state = "failed";
      part.error = error;
    }
    this.loading = null;
    this._makeRoom();
    this.onNews();
    this.want(this.frame);
  }

  _forget(part) {
    Object.assign(part, { state: "absent", packets: [], bytes: 0, error: null });
  }

  _makeRoom() {
    let bytes = this.parts.reduce((sum, part) => sum + part.bytes, 0);
    const here = this.parts.indexOf(this._part(this.frame));
    const far = this.parts.map((part, i) => ({ part, way: i < here ? here - i : (i - here) / 2 }));
    for (const { part, way } of far.sort((a, b) => b.way - a.way)) {
      if (bytes <= MOST_BYTES || way <= 1) return;
      bytes -= part.bytes;
      if (part.state === "done") this._forget(part);
    }
  }
}
