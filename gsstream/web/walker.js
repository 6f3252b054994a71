// Packets of a stream as its bytes arrive: from a file that is there, a download, or a file that grows.

import { FILE_HEADER, KIND, KIND_NAMES, PACKET_HEADER, checkFileHeader, parseHeader, parseIndex } from "./container.js";
import { PacketError } from "./errors.js";

/**
 * Cuts bytes into packets and checks their order. Memory grows with the bytes pushed and not yet taken, never with the
 * lengths that they announce.
 */
export class PacketWalker {
  /**
   * `offset`: byte of the file at which the pushed bytes begin; 0 expects the file header first. `frame`: that of the
   * first packet where it need not be a key packet, else null.
   */
  constructor(offset = 0, frame = null) {
    this.offset = offset;
    this.chunks = [];
    this.size = 0;
    this.version = null;
    this.last = frame === null ? null : { kind: KIND.delta, frame: frame - 1 };
    this.keys = [];
    this.whole = offset === 0;
  }

  push(chunk) {
    if (chunk.length) this.chunks.push(chunk);
    this.size += chunk.length;
  }

  /** The next `size` bytes, which stay; null until they are there. */
  ahead(size) {
    return this.size < size ? null : this._peek(size);
  }

  /** The next complete packet `{ data, offset, header }`, or null until more bytes come. Throws PacketError. */
  next() {
    if (this.whole && this.version === null) {
      const head = this.ahead(FILE_HEADER);
      if (!head) return null;
      this.version = checkFileHeader(head);
      this._take(FILE_HEADER);
    }
    const head = this.ahead(PACKET_HEADER);
    const header = head && parseHeader(head, this.offset);
    if (!head || this.size < PACKET_HEADER + header.body) return null;
    this._checkOrder(header);
    const { offset } = this;
    const data = this._take(PACKET_HEADER + header.body);
    if (header.kind === KIND.index) this._checkIndex(data, offset);
    if (header.kind === KIND.key) this.keys.push({ frame: header.frame, offset });
    this.last = header;
    return { data, offset, header };
  }

  /** After the last byte: throws PacketError when not even the file header is there. What is unfinished is ignored. */
  finish() {
    if (this.whole && this.version === null) checkFileHeader(this._peek(this.size));
    if (this.last === null) throw new PacketError("the stream holds no complete packet yet", this.offset);
  }

  _checkOrder({ kind, frame }) {
    const { last, offset } = this;
    if (last === null) {
      if (kind !== KIND.key) throw new PacketError(`expected a key packet first, got ${KIND_NAMES[kind]}`, offset);
      return;
    }
    if (last.kind === KIND.index) throw new PacketError("a packet follows the index, which must be the last", offset);
    const expected = kind === KIND.index ? last.frame : last.frame + 1;
    if (frame !== expected) {
      throw new PacketError(
        `frames must be consecutive: expected ${expected} after ${last.frame}, got ${frame}`,
        offset,
      );
    }
  }

  _checkIndex(data, offset) {
    const listed = parseIndex(data, offset);
    if (!this.whole) return;
    const same =
      listed.length === this.keys.length &&
      listed.every((key, i) => key.frame === this.keys[i].frame && key.offset === this.keys[i].offset);
    if (!same) throw new PacketError("the index does not describe this stream", offset);
  }

  _peek(size) {
    if (this.chunks.length && this.chunks[0].length >= size) return this.chunks[0].subarray(0, size);
    const joined = new Uint8Array(Math.max(size, 0));
    let at = 0;
    for (const chunk of this.chunks) {
      const part = chunk.subarray(0, size - at);
      joined.set(part, at);
      at += part.length;
      if (at === size) break;
    }
    return joined;
  }

  _take(size) {
    const data = this._peek(size).slice();
    let left = size;
    while (left > 0) {
      const chunk = this.chunks[0];
      if (chunk.length <= left) this.chunks.shift();
      else this.chunks[0] = chunk.subarray(left);
      left -= Math.min(left, chunk.length);
    }
    this.size -= size;
    this.offset += size;
    return data;
  }
}
