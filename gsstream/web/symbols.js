// Tables of integers: a histogram for each channel (or one for all), then entropy-coded bins, then escaped values.

import { BitReader, unpackParts } from "./bits.js";
import { PacketError } from "./errors.js";
import { MAX_BINS } from "./limits.js";

const INT32 = 2 ** 31;

/**
 * Decode symbols of `rows` rows into an Int32Array, channel after channel: symbol (row, c) is at c * rows + row.
 *
 * Throws PacketError when the bytes are not such a table.
 */
export function decodeSymbols(data, rows, channels) {
  if (rows * channels === 0) {
    if (data.length) throw new PacketError(`${data.length} bytes for an empty table`);
    return new Int32Array(0);
  }
  const [headBytes, words] = unpackParts(data, 2);
  const head = new BitReader(headBytes);
  const shared = head.bits(1) === 1;
  const models = [];
  for (let channel = 0; channel < channels; channel += 1) {
    models.push(shared && channel ? models[0] : readModel(head));
  }
  const coder = new AnsDecoder(words);
  const out = new Int32Array(rows * channels);
  for (let channel = 0; channel < channels; channel += 1) {
    const model = models[channel];
    const column = out.subarray(channel * rows, (channel + 1) * rows);
    if (model.counts.length === 1) {
      column.fill(model.low);
    } else {
      model.cumulative ??= quantiseCounts(model.counts);
      coder.decode(model.cumulative, model.low, column);
    }
    if (model.escapes) readEscaped(column, model, head);
  }
  head.finish();
  if (!coder.isEmpty) throw new PacketError("entropy-coded words are left over after the last symbol");
  return out;
}

/** Values that left the histogram stand in its last bin; they are read from the head. */
function readEscaped(column, { low, bins }, head) {
  // As 32 bits: the bin of a histogram that ends at 2^31 - 1 wraps around, in `column` as here.
  const mark = (low + bins) | 0;
  for (let i = 0; i < column.length; i += 1) {
    if (column[i] !== mark) continue;
    const below = head.bits(1);
    const distance = head.gamma();
    const value = below ? low - 1 - distance : low + bins + distance;
    if (value < -INT32 || value >= INT32) throw new PacketError(`escaped symbol ${value} does not fit 32 bits`);
    column[i] = value;
  }
}

function readModel(head) {
  const low = head.signed();
  const bins = head.gamma() + 1;
  const escapes = head.bits(1);
  if (bins > MAX_BINS || low < -INT32 || low > INT32 - bins) {
    throw new PacketError(`histogram of ${bins} bins from ${low}: expected at most ${MAX_BINS} within 32 bits`);
  }
  const counts = bins + escapes > 1 ? readCounts(head, bins + escapes) : [1];
  if (!counts.some((count) => count > 0)) throw new PacketError("histogram without any count");
  return { low, bins, escapes, counts, cumulative: null };
}

/** A count is sent as its bit length and two leading bits; it is the middle of the interval they leave. */
function readCounts(head, number) {
  const counts = new Float64Array(number);
  let length = 0;
  for (let i = 0; i < number; i += 1) {
    length += head.signed();
    if (length < 0 || length > 32) throw new PacketError(`histogram count of ${length} bits: expected 0 to 32`);
    if (length) {
      const width = Math.min(length - 1, 2);
      const top = 2 ** width + head.bits(width);
      const shift = length - 1 - width;
      counts[i] = top * 2 ** shift + (shift ? 2 ** (shift - 1) : 0);
    }
  }
  return counts;
}

/** The largest magnitude in a table; 0 of an empty one. */
export function largest(values) {
  let most = 0;
  for (let i = 0; i < values.length; i += 1) most = Math.max(most, Math.abs(values[i]));
  return most;
}

/** The table, of which no value may lie outside of `low` to `high`: else a PacketError says so. */
export function within(values, low, high, message) {
  for (let i = 0; i < values.length; i += 1) if (values[i] < low || values[i] > high) throw new PacketError(message);
  return values;
}

// The entropy decoder: 64-bit state, 32-bit words, 24-bit models (sections 2.5 and 2.6 of docs/spec).
//
// The state is kept as two halves of 32 bits, and multiplied in pieces of 12 and 16: all of it is arithmetic of 32-bit
// integers, exact without BigInt.

const PRECISION = 24;
const TOTAL = 2 ** PRECISION;
const GUIDE_BITS = 10;
const GUIDE_SHIFT = PRECISION - GUIDE_BITS;

/**
 * Left ends of the intervals of every symbol in units of 2^-24, and 2^24 last.
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
    const common = widest(model);
    const begins = model[common];
    const ends = model[common + 1];
    const { view } = this;
    let { low, high, left } = this;
    for (let i = 0; i < out.length; i += 1) {
      const quantile = low & (TOTAL - 1);
      let begin = begins;
      let width = ends - begins;
      if (quantile >= begins && quantile < ends) {
        // The commonest symbol needs no tables.
        out[i] = common + shift;
      } else {
        let symbol = guide[quantile >>> GUIDE_SHIFT];
        let last = guide[(quantile >>> GUIDE_SHIFT) + 1];
        while (symbol < last) {
          const middle = (symbol + last + 1) >>> 1;
          if (model[middle] <= quantile) symbol = middle;
          else last = middle - 1;
        }
        begin = model[symbol];
        width = model[symbol + 1] - begin;
        out[i] = symbol + shift;
      }
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
    }
    this.low = low;
    this.high = high;
    this.left = left;
  }
}

/** The symbol with the widest interval. */
function widest(model) {
  let best = 0;
  for (let symbol = 1; symbol < model.length - 1; symbol += 1) {
    if (model[symbol + 1] - model[symbol] > model[best + 1] - model[best]) best = symbol;
  }
  return best;
}

// Gates: alternating runs of closed and open entries, with a level for each open one.

const DIRECT = 16;
const DIRECT_BITS = 4;

/** Decode gates of `number` entries: `{ gates: Uint8Array, levels }`; 0 is closed, `levels` is fully open. */
export function decodeGates(data, number) {
  const [headBytes, even, odd, levelBytes] = unpackParts(data, 4);
  const head = new BitReader(headBytes);
  const levels = head.gamma() + 1;
  const count = head.gamma();
  const first = head.bits(1);
  if (levels > 255 || count > number || (count === 0) !== (number === 0)) {
    throw new PacketError(`gates: ${levels} levels in ${count} runs over ${number} nodes cannot be`);
  }
  const runs = new Float64Array(count);
  [even, odd].forEach((part, parity) => {
    const sent = Math.max(0, Math.ceil((count - 1 - parity) / 2));
    const tokens = within(decodeSymbols(part, sent, 1), 0, DIRECT + 2 * 28 - 1, "run-length token out of range");
    for (let i = 0; i < sent; i += 1) runs[2 * i + parity] = runLength(tokens[i], head) + 1;
  });
  head.finish();
  const gates = new Uint8Array(number);
  let open = fillRuns(gates, runs, first);
  if (levels === 1) open = 0;
  const values = within(decodeSymbols(levelBytes, open, 1), 1, levels, `gate level outside 1 to ${levels}`);
  if (open) for (let i = 0, k = 0; i < number; i += 1) if (gates[i]) gates[i] = values[k++];
  return { gates, levels };
}

/** Write ones where runs are open; the last run is what is left. Returns how many entries are open. */
function fillRuns(gates, runs, first) {
  if (runs.length === 0) return 0;
  let sum = 0;
  for (let i = 0; i < runs.length - 1; i += 1) sum += runs[i];
  runs[runs.length - 1] = gates.length - sum;
  if (runs[runs.length - 1] < 1) {
    throw new PacketError(`gate runs cover more than the ${gates.length} nodes of the scene`);
  }
  let at = 0;
  let open = 0;
  for (let i = 0; i < runs.length; i += 1) {
    if ((i + first) % 2) {
      gates.fill(1, at, at + runs[i]);
      open += runs[i];
    }
    at += runs[i];
  }
  return open;
}

function runLength(token, head) {
  if (token < DIRECT) return token;
  const length = ((token - DIRECT) >> 1) + DIRECT_BITS;
  const second = (token - DIRECT) & 1;
  return 2 ** length + second * 2 ** (length - 1) + head.bits(length - 1);
}
