// The packets that are there, and the downloads that bring those that will be needed.

import { KIND } from "./container.js";
import { fileOf } from "./download.js";
import { packetsOf } from "./source.js";

/** Seconds of playing that are loaded ahead. */
const PREFETCH_SECONDS = 30;
/** Bytes of packets beyond which segments that lie far behind are forgotten. */
const MAX_BYTES = 128 * 2 ** 20;
/** Up to so many seconds ahead, deltas are replayed instead of loading a join. */
const MAX_REPLAY_SECONDS = 1;

/**
 * Packets by frame, loaded piece by piece around the frame that is played. `onNews` is called for every packet; for
 * `onPart` see packetsOf.
 */
export class PacketBuffer {
  constructor(segments, onNews, onPart) {
    this.parts = segments.map((segment) => ({ segment, state: "absent", packets: [], bytes: 0, error: null }));
    let home = null;
    for (const part of this.parts) {
      if (!part.segment.join) home = part;
      Object.assign(part, { home, key: null, join: part.segment.join ? { state: "absent", data: null } : null });
    }
    Object.assign(this, { onNews, onPart });
    this.received = 0;
    this.fps = 30;
    this.frame = null;
    this.from = null;
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
    return part ? lastOf(part) : null;
  }

  /** The packet of a frame, or undefined. */
  packet(frame) {
    const part = this._part(frame);
    return part?.packets[frame - part.packets[0]?.header.frame];
  }

  /**
   * What leads from the state after frame `from` (null: there is none) towards `frame`: `{ packet }`, the next one or a
   * key packet to start from; `{ key, join, decode }`, a key packet, the data of a join and its decoder; or null while
   * that is not loaded.
   */
  towards(frame, from) {
    const { part, join } = this._way(frame, from);
    if (join) {
      const key = this._keyPacket(part);
      return key && join.data ? { key, join: join.data, decode: join.decode } : null;
    }
    const key = this._keyOf(frame);
    if (key === null) return null;
    const packet = this.packet(from !== null && from >= key && from < frame ? from + 1 : key);
    return packet ? { packet } : null;
  }

  /** Why a frame will not come: the error that ended its segment, or null while it may still come. */
  failure(frame, from) {
    const { parts, join } = this._way(frame, from);
    if (join && join.state !== "done") return null;
    const failed = parts.find((part) => part.state === "failed");
    if (failed) return failed.error;
    return parts.every((part) => part.state === "done") ? new Error("The stream is cut short here.") : null;
  }

  /** A packet or the join that leads to a frame turned out to be damaged. Returns whether there is another way. */
  spoil(frame, error, byJoin) {
    const part = this._part(frame);
    if (byJoin) part.join = { state: "failed", data: null };
    else if (this.parts.length > 1) Object.assign(part, { state: "failed", error });
    return byJoin;
  }

  /** First frame of the next piece after that of `frame` at which playing can begin, or null. */
  nextSegment(frame) {
    const part = this.parts[this.parts.indexOf(this._part(frame)) + 1];
    return part ? part.segment.first : null;
  }

  /** Seconds loaded without a gap from `frame` on. */
  secondsAfter(frame) {
    let end = frame;
    for (let part = this._part(frame); part; part = this._part(end + 1)) {
      const last = lastOf(part);
      if (last === null || last < end || (part.state !== "done" && last <= end)) break;
      end = last;
      if (part.state !== "done" || end + 1 > (this.last ?? end)) break;
    }
    return Math.max(0, (end - frame) / this.fps);
  }

  /**
   * Load what leads from the state after frame `from` (null: there is none) to `frame`, and the seconds after it. A
   * download that is not needed now is given up.
   */
  want(frame, from = null) {
    Object.assign(this, { frame, from });
    const needed = this._needed(frame, from);
    const absent = needed.filter(isAbsent);
    const { loading } = this;
    if (loading && absent.length && !needed.some((job) => job.part === loading.part && job.join === loading.join)) {
      loading.abort.abort(new DOMException("another part is needed", "AbortError"));
      this.loading = null;
    }
    const [job] = absent.length ? absent : this._ahead(frame);
    if (job && !this.loading) this._load(job);
  }

  /** Try again what failed. */
  retry() {
    for (const part of this.parts) {
      if (part.state === "failed") this._forget(part);
      if (part.join?.state === "failed") part.join.state = "absent";
    }
  }

  dispose() {
    this.loading?.abort.abort(new DOMException("the player is closed", "AbortError"));
  }

  _part(frame) {
    if (this.parts.length === 1) return this.parts[0];
    return this.parts.find(({ segment }) => segment.first <= frame && frame <= segment.last);
  }

  /** `{ part, parts, join }`: the piece of `frame`, those that are decoded on the way, and the join to begin with. */
  _way(frame, from) {
    const part = this._part(frame) ?? this.parts[0];
    if (!part.join) return { part, parts: [part], join: null };
    const since = (start) => this.parts.slice(this.parts.indexOf(start), this.parts.indexOf(part) + 1);
    if (from !== null && from < frame && from >= part.home.segment.first) {
      const parts = since(this._part(from + 1));
      if (parts.length === 1 || frame - from <= MAX_REPLAY_SECONDS * this.fps) return { part, parts, join: null };
    }
    if (part.join.state !== "failed") return { part, parts: [part], join: part.join };
    return { part, parts: since(part.home), join: null };
  }

  _keyPacket(part) {
    return part.home.packets[0] ?? part.home.key;
  }

  /** Frame of the nearest key packet at or before `frame`, or null while it is not loaded. */
  _keyOf(frame) {
    const part = this._part(frame);
    if (part?.join) return part.home.segment.first;
    const start = part?.packets[0]?.header.frame;
    if (start === undefined) return null;
    for (let i = Math.min(frame - start, part.packets.length - 1); i >= 0; i -= 1) {
      if (part.packets[i].header.kind === KIND.key) return part.packets[i].header.frame;
    }
    return null;
  }

  /** Downloads that `frame` waits for, `{ part, join }` each, in order; also those that are done. */
  _needed(frame, from) {
    const { part, parts, join } = this._way(frame, from);
    return [...(join ? [{ part, join: true }] : []), ...parts.map((one) => ({ part: one, join: false }))];
  }

  /** Downloads for the time after `frame` that have not begun. */
  _ahead(frame) {
    const here = this.parts.indexOf(this._part(frame));
    const soon = this.parts.slice(here + 1).filter(({ segment }) => (segment.first - frame) / this.fps <= PREFETCH_SECONDS);
    return here < 0 ? [] : soon.map((part) => ({ part, join: false })).filter(isAbsent);
  }

  async _load(job) {
    const abort = new AbortController();
    const { part } = job;
    const place = job.join ? part.join : part;
    this.loading = { ...job, abort };
    if (!job.join) this._forget(part);
    place.state = "loading";
    try {
      await (job.join ? this._loadJoin(part, abort.signal) : this._loadPackets(part, abort.signal));
      if (!abort.signal.aborted) place.state = "done";
    } catch (error) {
      if (!abort.signal.aborted) Object.assign(place, { state: "failed", error });
    }
    // What was given up may have come to its end all the same, and what it brought may have been forgotten.
    if (abort.signal.aborted) {
      this._unfinished();
      return;
    }
    this.loading = null;
    this._unfinished();
    this._makeRoom();
    this.onNews();
    this.want(this.frame, this.from);
  }

  /** Packets of a piece; those of others, when the server sends the whole file, are kept as well. */
  async _loadPackets(part, signal) {
    for await (const packet of packetsOf(part.segment, signal, this.onPart)) {
      const { kind, frame } = packet.header;
      const owner = this._part(frame) ?? part;
      const expected = owner.packets.length ? lastOf(owner) + 1 : (owner.segment.first ?? frame);
      if (kind === KIND.index || owner.state === "done" || frame !== expected) continue;
      owner.packets.push(packet);
      owner.bytes += packet.data.length;
      owner.state = frame === owner.segment.last && owner !== part ? "done" : "loading";
      this.received += packet.data.length;
      this.onNews();
    }
  }

  async _loadJoin(part, signal) {
    const { key, join } = part.segment;
    if (!this._keyPacket(part)) {
      for await (const packet of packetsOf(key, signal)) part.home.key = packet;
      this.received += part.home.key.data.length;
    }
    // Only who seeks needs this module.
    const { decodeJoin } = await import("./joins.js");
    const data = await fileOf(join.url, { bytes: join.bytes, signal });
    Object.assign(part.join, { data, decode: decodeJoin });
    this.received += part.join.data.length;
  }

  /** Forget what is half there and not being loaded any more. */
  _unfinished() {
    for (const part of this.parts) {
      if (part === this.loading?.part) continue;
      if (part.state === "loading") this._forget(part);
      if (part.join?.state === "loading") part.join.state = "absent";
    }
  }

  _forget(part) {
    Object.assign(part, { state: "absent", packets: [], bytes: 0, error: null });
  }

  _makeRoom() {
    let bytes = this.parts.reduce((sum, part) => sum + part.bytes, 0);
    const here = this.parts.indexOf(this._part(this.frame));
    const far = this.parts.map((part, i) => ({ part, way: i < here ? here - i : (i - here) / 2 }));
    for (const { part, way } of far.sort((a, b) => b.way - a.way)) {
      if (bytes <= MAX_BYTES || way <= 1) return;
      bytes -= part.bytes;
      if (part.state === "done") this._forget(part);
      if (part.join?.state === "done") part.join = { state: "absent", data: null };
    }
  }
}

function lastOf(part) {
  return part.packets.length ? part.packets[part.packets.length - 1].header.frame : null;
}

function isAbsent({ part, join }) {
  return (join ? part.join : part).state === "absent";
}
