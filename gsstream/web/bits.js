// Bit fields and parts (chapter 2 of docs/spec). Most significant bit first, zero padded to a byte.

import { PacketError } from "./errors.js";

const MAX_PREFIX = 36;

/** Reads bit fields of a byte string. Values may be wider than 32 bits, so they are built without bit operators. */
export class BitReader {
  constructor(data) {
    this.data = data;
    this.at = 0;
    this.end = 8 * data.length;
  }

  /** The next `width` bits (at most 52) as a number. */
  bits(width) {
    if (this.at + width > this.end) {
      throw new PacketError(`bit field of ${width} bits runs past the end of its section`);
    }
    let value = 0;
    let left = width;
    while (left > 0) {
      const offset = this.at & 7;
      const taken = Math.min(8 - offset, left);
      const byte = this.data[this.at >>> 3];
      value = value * (1 << taken) + ((byte >>> (8 - offset - taken)) & ((1 << taken) - 1));
      this.at += taken;
      left -= taken;
    }
    return value;
  }

  /** An Exp-Golomb code of order 0. */
  gamma() {
    const limit = Math.min(this.at + MAX_PREFIX, this.end);
    let one = this.at;
    while (one < limit && !((this.data[one >>> 3] >>> (7 - (one & 7))) & 1)) one += 1;
    if (one === limit) throw new PacketError("number code without an end, or too large");
    const zeros = one - this.at;
    this.at = one;
    return this.bits(zeros + 1) - 1;
  }

  /** A signed number: zigzag, then Exp-Golomb. */
  signed() {
    const value = this.gamma();
    return value % 2 ? -((value + 1) / 2) : value / 2;
  }

  /** Only zero padding to the next byte may be left. */
  finish() {
    const rest = this.end - this.at;
    if (rest >= 8 || (rest > 0 && this.bits(rest) !== 0)) {
      throw new PacketError(`${rest} bits left over after the last field`);
    }
  }
}

/** Split a payload into `count` parts, each but the last preceded by its length as LEB128. */
export function unpackParts(data, count) {
  const parts = [];
  let at = 0;
  for (let i = 0; i < count - 1; i += 1) {
    let length = 0;
    let shift = 0;
    for (;;) {
      if (at >= data.length || shift > 28) throw new PacketError("length of a part runs past the end of its section");
      const byte = data[at];
      at += 1;
      length += (byte & 127) * 2 ** shift;
      shift += 7;
      if (byte < 128) break;
    }
    if (length > data.length - at) {
      throw new PacketError(`part of ${length} bytes announced, ${data.length - at} left in the section`);
    }
    parts.push(data.subarray(at, at + length));
    at += length;
  }
  parts.push(data.subarray(at));
  return parts;
}
