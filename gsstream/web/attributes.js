// Whole Gaussians as integers: the attribute sections of a key packet, and the added Gaussians of a delta packet.

import { BitReader, unpackParts } from "./bits.js";
import { PacketError, located } from "./errors.js";
import { MAX_BITS, MAX_CODE, WIDTHS } from "./limits.js";
import { decodeSymbols, within } from "./symbols.js";

const MAX_DEPTH = 24;
const MAX_EXPONENT = 60;
const MAX_CELL = 2 ** 29;
const LOG2E = 1512775;

/**
 * Decode whole Gaussians: attribute -> Float32Array of `number` rows, all six attributes.
 *
 * `sections`: attribute -> `{ data, offset }`. Throws PacketError with the offset of the section.
 */
export function decodeAttributes(sections, number) {
  const out = {};
  for (const name of ["quats", "scales", "opacities", "sh0", "shN"]) {
    const { data, offset } = sections[name];
    const { codes, bits, width } = located(offset, () => decodeCodes(name, data, number));
    out[name] = name === "sh0" || name === "shN" ? fromLuma(codes, bits, width) : fromCodes(codes, bits, width);
    if (name === "scales") {
      const means = sections.means;
      out.means = located(means.offset, () => decodePositions(means.data, codes, bits, number));
    }
  }
  return out;
}

function decodeCodes(name, data, number) {
  if (data.length < 2) throw new PacketError(`${name} cut short`);
  const bits = (data[0] << 24) >> 24;
  const width = data[1];
  if (!WIDTHS[name].includes(width) || bits < 1 || bits > MAX_BITS) {
    throw new PacketError(`${name}: ${width} channels of ${bits} fractional bits cannot be`);
  }
  const payload = data.subarray(2);
  if (name === "quats") return { codes: unfoldQuats(decodeSymbols(payload, number, 5), bits), bits, width };
  const codes = decodeSymbols(payload, number, width);
  return { codes: within(codes, 1 - MAX_CODE, MAX_CODE - 1, `${name}: code out of range`), bits, width };
}

/** Codes of quaternions from five symbols each: the largest component is what the unit norm leaves for it. */
function unfoldQuats(symbols, bits) {
  const number = symbols.length / 5;
  const out = new Int32Array(4 * number);
  const one = 4 ** bits;
  within(symbols.subarray(0, number), 0, 3, "quats: the index of the largest component is outside 0 to 3");
  within(symbols.subarray(number, 4 * number), 1 - MAX_CODE, MAX_CODE - 1, "quats: code out of range");
  for (let i = 0; i < number; i += 1) {
    const largest = symbols[i];
    let squares = 0;
    let most = 0;
    for (let k = 0, to = 0; k < 3; k += 1, to += 1) {
      if (to === largest) to += 1;
      const code = symbols[(1 + k) * number + i];
      out[to * number + i] = code;
      squares += code * code;
      most = Math.max(most, Math.abs(code));
    }
    // The root of an integer below 2^42 is never halfway between two integers, so both ways of rounding agree.
    const value = symbols[4 * number + i] + Math.round(Math.sqrt(Math.max(one - squares, 0)));
    if (value < most || value <= 0 || value >= MAX_CODE) {
      throw new PacketError("quats: the largest component is not the largest, or out of range");
    }
    out[largest * number + i] = value;
  }
  return out;
}

/** Values row by row from codes channel by channel. */
function fromCodes(codes, bits, width) {
  const out = new Float32Array(codes.length);
  const number = codes.length / width;
  const step = 2 ** -bits;
  for (let c = 0; c < width; c += 1) {
    for (let i = 0; i < number; i += 1) out[i * width + c] = codes[c * number + i] * step;
  }
  return out;
}

/** Colours from luma and two chroma channels; every sum is exact in float64 and rounded once. */
function fromLuma(codes, bits, width) {
  const out = new Float32Array(codes.length);
  if (width === 0) return out;
  const number = codes.length / width;
  const fine = 2 ** -bits;
  const coarse = 2 ** (1 - bits);
  for (let i = 0; i < number; i += 1) {
    for (let c = 0; c < width; c += 3) {
      const orange = codes[(c + 1) * number + i] * coarse;
      const green = codes[(c + 2) * number + i] * coarse;
      const middle = codes[c * number + i] * fine - green / 2;
      const blue = middle - orange / 2;
      out[i * width + c] = blue + orange;
      out[i * width + c + 1] = green + middle;
      out[i * width + c + 2] = blue;
    }
  }
  return out;
}

// Positions of a key packet: a cell, and bits within it as many as the Gaussian is small.

/** Decode [N, 3] positions. `scales`: integer codes of three channels with `bits` fractional bits. */
function decodePositions(data, scales, bits, number) {
  if (number === 0) {
    if (data.length) throw new PacketError(`${data.length} bytes for no positions`);
    return new Float32Array(0);
  }
  if (data.length < 3) throw new PacketError("means cut short");
  const [floor, fineness, cell] = new Int8Array(data.slice(0, 3).buffer);
  if (Math.abs(floor) > MAX_EXPONENT || Math.abs(cell) > MAX_EXPONENT || cell < floor || cell - floor > MAX_DEPTH) {
    throw new PacketError(`means: cells of 2^${cell} in steps of 2^${floor} cannot be`);
  }
  const [symbols, fields] = unpackParts(data.subarray(3), 2);
  const moves = decodeSymbols(symbols, number, 3);
  const depths = new Uint8Array(number);
  let total = 0;
  for (let i = 0; i < number; i += 1) {
    const smallest = Math.min(scales[i], scales[number + i], scales[2 * number + i]);
    const exponent = Math.max(floor, Math.floor((smallest * LOG2E) / 2 ** (20 + bits)) - fineness);
    depths[i] = Math.max(0, cell - exponent);
    total += 3 * depths[i];
  }
  const cells = checkCells(moves, number);
  checkFields(fields, total);
  return place(cells, depths, fields, 2 ** cell);
}

/** Running sums of the moves, as exact float64 integers, row by row. */
function checkCells(moves, number) {
  const cells = new Float64Array(3 * number);
  for (let axis = 0; axis < 3; axis += 1) {
    let cell = 0;
    for (let i = 0; i < number; i += 1) {
      cell += moves[axis * number + i];
      if (cell > MAX_CELL || cell < -MAX_CELL) throw new PacketError("means: a cell is out of range");
      cells[3 * i + axis] = cell;
    }
  }
  return cells;
}

function checkFields(fields, total) {
  const size = Math.ceil(total / 8);
  if (fields.length !== size) {
    throw new PacketError(`means: expected ${size} bytes of positions in cells, got ${fields.length}`);
  }
  if (total % 8 && fields[size - 1] & (0xff >> (total % 8))) {
    throw new PacketError("means: padding after the last position is not zero");
  }
}

function place(cells, depths, fields, side) {
  const out = new Float32Array(cells.length);
  const reader = new BitReader(fields);
  const steps = Float64Array.from({ length: MAX_DEPTH + 1 }, (_, depth) => 2 ** -depth);
  for (let i = 0; i < cells.length; i += 1) {
    const depth = depths[(i / 3) | 0];
    out[i] = (cells[i] + reader.bits(depth) * steps[depth]) * side;
  }
  return out;
}
