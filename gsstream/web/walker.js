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
    if (this.size < size) return null;
    if (size && this.chunks[0].length < size) this.chunks = [concatenated(this.chunks, this.size)];
    return this.chunks[0]?.subarray(0, size) ?? new Uint8Array(0);
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
    if (this.whole && this.version === null) checkFileHeader(this.ahead(this.size));
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

  _take(size) {
    const data = this.ahead(size).slice();
    this.chunks[0] = this.chunks[0].subarray(size);
    if (!this.chunks[0].length) this.chunks.shift();
    this.size -= size;
    this.offset += size;
    return data;
  }
}

function concatenated(chunks, size) {
  const out = new Uint8Array(size);
  let at = 0;
  for (const chunk of chunks) {
    out.set(chunk, at);
    at += chunk.length;
  }
  return out;
}
