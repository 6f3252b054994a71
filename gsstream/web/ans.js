// The entropy decoder: the stack coder of constriction 0.5 (64-bit state, 32-bit words) with 24-bit categorical models.
//
// The state is kept as two halves of 32 bits, and multiplied in pieces of 12 and 16: all of it is arithmetic of 32-bit
// integers, exact without BigInt.

import { PacketError } from "./errors.js";

const PRECISION = 24;
const TOTAL = 2 ** PRECISION;
const GUIDE_BITS = 10;
const GUIDE_SHIFT = PRECISION - GUIDE_BITS;

/**
 * Left ends of the intervals of every symbol in units of 2^-24, and 2^24 last: `Categorical(counts, perfect=False)`.
 *
 * Every symbol first gets one unit; the rest is shared by the counts, cut off towards zero, in float64.
 */
export function quantiseCounts(counts) {
  const number = counts.length;
  let sum = 0;
  for (let i = 0; i < number; i += 1) sum += counts[i];
  const scale = (TOTAL - number) / sum;
  const left = new Int32Array(number + 1);
  let before = 0;
  for (let i = 0; i < number; i += 1) {
    left[i] = Math.trunc(before * scale) + i;
    before += counts[i];
  }
  left[number] = TOTAL;
  return left;
}

/** For each of 1024 equal parts of the unit interval the symbol that its left end falls into: bounds the search. */
function searchGuide(left) {
  const guide = new Uint16Array((1 << GUIDE_BITS) + 1);
  let symbol = 0;
  for (let i = 0; i < 1 << GUIDE_BITS; i += 1) {
    while (left[symbol + 1] <= i * 2 ** GUIDE_SHIFT) symbol += 1;
    guide[i] = symbol;
  }
  guide[1 << GUIDE_BITS] = left.length - 2;
  return guide;
}

/** Decodes symbols from words, last word first. */
export class AnsDecoder {
  /** `data`: the words as little-endian bytes. Throws PacketError when they are no coder's output. */
  constructor(data) {
    if (data.length % 4)
      throw new PacketError(`entropy-coded words: expected a multiple of 4 bytes, got ${data.length}`);
    this.view = new DataView(data.buffer, data.byteOffset, data.byteLength);
    this.left = data.length / 4;
    this.low = 0;
    this.high = 0;
    if (this.left === 0) return;
    const first = this._word();
    if (first === 0) throw new PacketError("entropy-coded words are not a valid stream: they end in a zero word");
    this.low = first;
    if (this.left > 0) {
      this.high = first;
      this.low = this._word();
    }
  }

  get isEmpty() {
    return this.low === 0 && this.high === 0;
  }

  _word() {
    this.left -= 1;
    return this.view.getInt32(4 * this.left, true);
  }

  /** Fill `out` with the next symbols of a model given by `quantiseCounts`, plus `low`. */
  decode(model, shift, out) {
    const guide = searchGuide(model);
    const { view } = this;
    let { low, high, left } = this;
    for (let i = 0; i < out.length; i += 1) {
      const quantile = low & (TOTAL - 1);
      let symbol = guide[quantile >>> GUIDE_SHIFT];
      let last = guide[(quantile >>> GUIDE_SHIFT) + 1];
      while (symbol < last) {
        const middle = (symbol + last + 1) >>> 1;
        if (model[middle] <= quantile) symbol = middle;
        else last = middle - 1;
      }
      const begin = model[symbol];
      const width = model[symbol + 1] - begin;
      // state = (state >> 24) * width + rest, of which `high` gets what is above 2^32.
      const rest = quantile - begin;
      const shifted = (high << 8) | (low >>> 24);
      const a = shifted >>> 16;
      const b = shifted & 0xffff;
      const w1 = width >>> 12;
      const w0 = width & 0xfff;
      const m = Math.imul(b, w1) + ((Math.imul(b, w0) + rest) >>> 12);
      const n = Math.imul(a, w0) + (m >>> 4);
      const k = Math.imul(a, w1) + (n >>> 12);
      low = (Math.imul(shifted, width) + rest) | 0;
      high = ((k >>> 4) + Math.imul(high >>> 24, width)) | 0;
      if (high === 0 && left > 0) {
        left -= 1;
        high = low;
        low = view.getInt32(4 * left, true);
      }
      out[i] = symbol + shift;
    }
    this.low = low;
    this.high = high;
    this.left = left;
  }
}
