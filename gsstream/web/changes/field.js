// Field: a hash grid and a small network say how the rows in a box move (section 4.5 of docs/spec).

import { unpackParts } from "../bits.js";
import { PacketError } from "../errors.js";
import { later } from "../key.js";
import { decodeGates, decodeSymbols } from "../symbols.js";
import { rodriguesToQuat, rotateQuat, unionRows } from "./motion.js";

const HEAD = 52;
const OUTPUTS = 7;
const MAX_ENTRIES = 2 ** 20;
const MAX_CELLS = 2 ** 20;
const MAX_OPERATIONS = 2 ** 35;
const MAX_ENTRY = 2 ** 25;
const MAX_WEIGHT = 2 ** 17;
const MAX_ACTIVATION = 2 ** 26 - 1;

/**
 * Decode a field and apply it to `moved`: `{ means, quats, groups, rows }` as `decodeMotions` returns it.
 *
 * Its arrays are changed in place. Returns it with the rows of the field among its rows.
 */
function decodeField({ data }, moved) {
  const shape = readHead(data);
  const parts = unpackParts(data.subarray(HEAD), 1 + shape.levels + shape.widths.length - 1);
  const rows = rowsInside(shape, parts[0], moved.means);
  const pairs = shape.widths.slice(1).map((outputs, layer) => [shape.widths[layer], outputs]);
  const each = 8 * shape.widths[0] + pairs.reduce((sum, [inputs, outputs]) => sum + inputs * outputs, 0);
  demand(rows.length * each <= MAX_OPERATIONS, `${rows.length} Gaussians are too many for its network`);
  const grids = shape.cells.map((_, level) => readLevel(shape, level, parts[1 + level], rows, moved.means));
  const layers = readLayers(shape, pairs, parts.slice(1 + shape.levels));
  for (const row of rows) moveRow(shape, grids, layers, moved, row);
  return { ...moved, rows: unionRows(moved.rows, rows) };
}

later.field = decodeField;

function demand(holds, what) {
  if (!holds) throw new PacketError(`field: ${what}`);
}

function readHead(data) {
  demand(data.length >= HEAD, "cut short");
  const [flags, levels, log, features, width, hidden] = data;
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const base = view.getUint16(6, true);
  const [seed, entryStep, weightStep] = [8, 12, 16].map((at) => view.getUint32(at, true));
  const [growth, reach, ...box] = Array.from({ length: 8 }, (_, i) => view.getFloat32(20 + 4 * i, true));
  demand(!(flags & ~1), `unknown flags ${flags}; a newer player is needed`);
  for (const [name, value, most] of [
    ["levels", levels, 16],
    ["entries", log, 20],
    ["numbers of an entry", features, 8],
    ["width", width, 128],
    ["hidden layers", hidden, 4],
    ["cells", base, 1024],
    ["step of entries", entryStep, MAX_ENTRY],
    ["step of weights", weightStep, MAX_WEIGHT],
  ]) {
    demand(value >= 1 && value <= most, `${name}: expected 1 to ${most}, got ${value}`);
  }
  demand(levels * 2 ** log <= MAX_ENTRIES, "its grid is too large");
  demand(growth >= 1 && growth <= 4 && reach > 0 && reach < 1e9, "growth or reach that cannot be");
  const lower = box.slice(0, 3);
  const upper = box.slice(3);
  const isBox = lower.every((value, axis) => value < upper[axis]) && box.every(Number.isFinite);
  demand(isBox, "a box whose corners cannot be");
  const cells = [];
  for (let level = 0, times = 1; level < levels; level += 1, times *= growth) cells.push(Math.trunc(base * times));
  demand(Math.max(...cells) <= MAX_CELLS, "too many cells");
  const widths = [levels * features, ...new Array(hidden).fill(width), OUTPUTS];
  const at = { unit: new Float64Array(3), entry: new Int32Array(8), weight: new Float64Array(8) };
  const marked = flags === 1;
  return { marked, levels, log, features, seed: mix(seed), entryStep, weightStep, reach, lower, upper, cells, widths, at };
}

/** The rows that the field moves, ascending. */
function rowsInside(shape, marks, means) {
  const number = means.length / 3;
  demand(shape.marked || !marks.length, "marks of rows, though all in the box move");
  const { gates, levels } = shape.marked ? decodeGates(marks, number) : { gates: null, levels: 1 };
  demand(levels === 1, "rows move or stand still, there are no levels");
  const rows = new Uint32Array(number);
  let found = 0;
  for (let row = 0; row < number; row += 1) {
    if ((!gates || gates[row]) && place(shape, means, row)) rows[found++] = row;
  }
  return rows.slice(0, found);
}

/** Where a row is in the box goes to `shape.at.unit`. Returns whether it is in it. */
function place({ lower, upper, at: { unit } }, means, row) {
  let inside = true;
  for (let axis = 0; axis < 3; axis += 1) {
    const u = (means[3 * row + axis] - lower[axis]) / (upper[axis] - lower[axis]);
    inside &&= u >= 0 && u <= 1;
    unit[axis] = u;
  }
  return inside;
}

/** The entries and the weights of the corners around the place in `shape.at`, on one level. */
function findCorners({ log, cells, at }, level) {
  const { unit, entry, weight } = at;
  const c = cells[level];
  const [x, y, z] = unit.map((u) => Math.min(Math.floor(u * c), c - 1));
  const [fx, fy, fz] = [unit[0] * c - x, unit[1] * c - y, unit[2] * c - z];
  const isDense = (c + 1) ** 3 <= 2 ** log;
  for (let corner = 0; corner < 8; corner += 1) {
    const [i, j, m] = [corner >> 2, (corner >> 1) & 1, corner & 1];
    const [X, Y, Z] = [x + i, y + j, z + m];
    const hashed = (X ^ Math.imul(2654435761, Y) ^ Math.imul(805459861, Z)) & (2 ** log - 1);
    entry[corner] = isDense ? (X * (c + 1) + Y) * (c + 1) + Z : hashed;
    weight[corner] = (i ? fx : 1 - fx) * (j ? fy : 1 - fy) * (m ? fz : 1 - fz);
  }
}

function mix(value) {
  let v = value ^ (value >>> 16);
  v = Math.imul(v, 0x7feb352d);
  v ^= v >>> 15;
  v = Math.imul(v, 0x846ca68b);
  return (v ^ (v >>> 16)) >>> 0;
}

function draw(n, range, seed) {
  return Math.floor(((mix(n + seed) >>> 8) * (2 * range + 1)) / 2 ** 24) - range;
}

/** What a symbol adds to what it starts from. */
function stepped(symbol, step, limit) {
  demand(Math.abs(symbol) * step < limit, "a symbol that cannot be");
  return symbol * step;
}

/** The numbers of all entries of a level; of those that no row touches, none is sent and none is used. */
function readLevel(shape, level, data, rows, means) {
  const { log, features, seed, entryStep, at } = shape;
  const entries = 2 ** log;
  const used = new Uint8Array(entries);
  for (const row of rows) {
    place(shape, means, row);
    findCorners(shape, level);
    for (let corner = 0; corner < 8; corner += 1) used[at.entry[corner]] = 1;
  }
  const touched = used.reduce((sum, one) => sum + one, 0);
  const symbols = decodeSymbols(data, touched, features);
  const out = new Int32Array(entries * features);
  for (let entry = 0, rank = 0; entry < entries; entry += 1) {
    if (!used[entry]) continue;
    for (let f = 0; f < features; f += 1) {
      const start = draw((level * entries + entry) * features + f, 105, seed);
      out[entry * features + f] = start + stepped(symbols[f * touched + rank], entryStep, MAX_ENTRY);
    }
    rank += 1;
  }
  return out;
}

/** Weights of every layer, [outputs] for each input. */
function readLayers({ seed, weightStep }, pairs, parts) {
  let n = 2 ** 31;
  return pairs.map(([inputs, outputs], layer) => {
    const range = layer < pairs.length - 1 ? Math.trunc(2 ** 14 * Math.sqrt(6 / inputs)) : 0;
    const symbols = decodeSymbols(parts[layer], inputs, outputs);
    const out = new Float64Array(inputs * outputs);
    for (let i = 0; i < out.length; i += 1, n += 1) {
      const symbol = symbols[(i % outputs) * inputs + Math.floor(i / outputs)];
      out[i] = draw(n, range, seed) + stepped(symbol, weightStep, MAX_WEIGHT);
    }
    return out;
  });
}

/** What the network says of the place in `shape.at`. All sums are whole numbers below 2^53, exact in any order. */
function evaluate(shape, grids, layers) {
  const { features, widths, at } = shape;
  let values = new Float64Array(widths[0]);
  grids.forEach((grid, level) => {
    findCorners(shape, level);
    for (let f = 0; f < features; f += 1) {
      let sum = 0;
      for (let corner = 0; corner < 8; corner += 1) sum += at.weight[corner] * grid[at.entry[corner] * features + f];
      values[level * features + f] = Math.floor(sum + 0.5);
    }
  });
  layers.forEach((weights, layer) => {
    const sums = new Float64Array(widths[layer + 1]);
    values.forEach((value, i) => {
      for (let o = 0; o < sums.length; o += 1) sums[o] += value * weights[i * sums.length + o];
    });
    const isLast = layer === layers.length - 1;
    const activated = (z) => Math.min(Math.max(Math.floor(z * 2 ** -14 + 0.5), 0), MAX_ACTIVATION);
    values = sums.map(isLast ? (z) => z * 2 ** -34 : activated);
  });
  return values;
}

function moveRow(shape, grids, layers, { means, quats }, row) {
  place(shape, means, row);
  const v = evaluate(shape, grids, layers);
  for (let axis = 0; axis < 3; axis += 1) means[3 * row + axis] += v[axis] * shape.reach;
  const real = Math.max(1 + v[3], 0.1);
  rotateQuat(quats, row, rodriguesToQuat(v.subarray(4).map((value) => value / real)), 0);
}
