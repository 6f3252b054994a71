// Positions of a key packet: a cell, and bits within it as many as the Gaussian is small.

import { unpackParts } from "./bits.js";
import { PacketError } from "./errors.js";
import { decodeSymbols } from "./symbols.js";

const MAX_DEPTH = 24;
const MAX_EXPONENT = 60;
const MAX_CELL = 2 ** 29;
const LOG2E = 1512775;

/** Decode [N, 3] positions into a Float32Array. `scales`: [N, 3] integer codes with `bits` fractional bits. */
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
    const smallest = Math.min(scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]);
    const exponent = Math.max(floor, Math.floor((smallest * LOG2E) / 2 ** (20 + bits)) - fineness);
    depths[i] = Math.max(0, cell - exponent);
    total += 3 * depths[i];
  }
  const cells = checkCells(moves, number);
  checkFields(fields, total);
  return place(cells, depths, fields, 2 ** cell);
}

/** Running sums of the moves, as exact float64 integers. */
function checkCells(moves, number) {
  const cells = new Float64Array(3 * number);
  for (let i = 0; i < 3 * number; i += 1) {
    cells[i] = moves[i] + (i < 3 ? 0 : cells[i - 3]);
    if (Math.abs(cells[i]) > MAX_CELL) throw new PacketError("means: a cell is out of range");
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
    out[i] = (cells[i] + field * 2 ** -depth) * side;
  }
  return out;
}
