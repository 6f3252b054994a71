// Tables of integers: a histogram for each channel (or one for all), then entropy-coded bins, then escaped values.

import { AnsDecoder, quantiseCounts } from "./ans.js";
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

/** Smallest and largest value of a table that is not empty. */
export function range(values) {
  let low = values[0];
  let high = values[0];
  for (let i = 1; i < values.length; i += 1) {
    if (values[i] < low) low = values[i];
    else if (values[i] > high) high = values[i];
  }
  return [low, high];
}
