// Positions of a key packet: a cell, and bits within it as many as the Gaussian is small.

import { unpackParts } from "./bits.js";
import { PacketError } from "./errors.js";
import { decodeSymbols } from "./symbols.js";

const MAX_DEPTH = 24;
const MAX_EXPONENT = 60;
const MAX_CELL = 2 ** 29;
const LOG2E = 1512775;

/** Decode [N, 3] positions. `scales`: integer codes of three channels with `bits` fractional bits. */
export function decodePositions(data, scales, bits, number) {
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
  let at = 0;
  const steps = Float64Array.from({ length: MAX_DEPTH + 1 }, (_, depth) => 2 ** -depth);
  for (let i = 0; i < cells.length; i += 1) {
    const depth = depths[(i / 3) | 0];
    let field = 0;
    let left = depth;
    while (left > 0) {
      const offset = at & 7;
      const taken = Math.min(8 - offset, left);
      field = (field << taken) | ((fields[at >>> 3] >>> (8 - offset - taken)) & ((1 << taken) - 1));
      at += taken;
      left -= taken;
    }
    out[i] = (cells[i] + field * steps[depth]) * side;
  }
  return out;
}
