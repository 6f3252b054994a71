// Motion: groups of rows move rigidly, as predicted from the last frame and corrected (section 4.4 of docs/spec).

import { unpackParts } from "../bits.js";
import { PacketError } from "../errors.js";
import { decodeGates, decodeSymbols } from "../symbols.js";

/** Sections that this change is made of. */
export const SECTIONS = ["motion"];

const PREDICTED = 1;
const REGROUP = 2;
const MAX_MOTIONS = 8;
const MAX_BINS = 16;
const MAX_TRANSLATION = 1e18;
const HALF_GRID = 32768;
const SH0 = 0.28209479177387814;

/**
 * Decode the motions of a frame and apply them, one after the other, to copies of what they change.
 *
 * Returns `{ means, quats, groups, rows }`: arrays of the whole scene after the motions, its groups, and the rows of
 * moving groups, ascending. Nothing of `state` changes but `state.spare`, the memory in which the copies lie: after the
 * motions of a frame, the scene before it, which differs in its `rows`. Where it does not, it is null.
 */
export function decodeMotions(section, state) {
  const number = section.data.length ? section.data[0] : 0;
  if (number < 1 || number > MAX_MOTIONS) {
    throw new PacketError(`motion: expected 1 to ${MAX_MOTIONS} motions, got ${number}`);
  }
  const { means, quats } = copied(state);
  let { groups } = state;
  let rows = new Uint32Array(0);
  for (const part of unpackParts(section.data.subarray(1), number)) {
    const scene = { means, quats, sh0: state.scene.sh0, groups };
    const motion = decodeMotion(part, scene);
    ({ groups } = motion);
    rows = unionRows(rows, applyTransforms(scene, motion, state.displacement));
  }
  return { means, quats, groups, rows };
}

/** Copies of the centres and rotations of a state, in its spare memory if there is any, which then is used up. */
export function copied(state) {
  const { scene, spare } = state;
  // Until a motion is applied as a whole, the content of the spare memory is undefined.
  state.spare = null;
  if (!spare) return { means: scene.means.slice(), quats: scene.quats.slice() };
  for (const row of spare.rows) {
    for (let i = 3 * row; i < 3 * row + 3; i += 1) spare.means[i] = scene.means[i];
    for (let i = 4 * row; i < 4 * row + 4; i += 1) spare.quats[i] = scene.quats[i];
  }
  return spare;
}

/** The rows of two ascending lists, ascending. */
export function unionRows(a, b) {
  const out = new Uint32Array(a.length + b.length);
  let at = 0;
  let i = 0;
  let k = 0;
  while (i < a.length && k < b.length) {
    const row = Math.min(a[i], b[k]);
    if (a[i] === row) i += 1;
    if (b[k] === row) k += 1;
    out[at++] = row;
  }
  for (; i < a.length; i += 1) out[at++] = a[i];
  for (; k < b.length; k += 1) out[at++] = b[k];
  return out.subarray(0, at);
}

function decodeMotion(data, scene) {
  if (data.length < 14) throw new PacketError("motion cut short");
  const [flags, bins] = data;
  if (flags & ~(PREDICTED | REGROUP)) throw new PacketError(`motion: unknown flags ${flags}; a newer player is needed`);
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const [cell, translationStep, rotationStep] = [2, 6, 10].map((at) => view.getFloat32(at, true));
  if (![cell, translationStep, rotationStep].every((value) => value > 0 && value < 1e9)) {
    throw new PacketError("motion: expected a cell and steps above 0 and below 1e9");
  }
  if (bins < 1 || bins > MAX_BINS) {
    throw new PacketError(`motion: expected 1 to ${MAX_BINS} classes of brightness, got ${bins}`);
  }
  const known = scene.groups;
  const keep = known && !(flags & REGROUP) && known.cell === cell && known.bins === bins;
  const groups = keep ? known : formGroups(scene, cell, bins);
  const [marks, table] = unpackParts(data.subarray(14), 2);
  const { gates: moving, levels } = decodeGates(marks, groups.count);
  if (levels !== 1) throw new PacketError("motion: groups move or stand still, there are no levels");
  const number = moving.reduce((sum, gate) => sum + gate, 0);
  const symbols = decodeSymbols(table, number, 6);
  for (let i = 0; i < symbols.length; i += 1) {
    const step = i < 3 * number ? translationStep : rotationStep;
    if (Math.abs(symbols[i]) * step > MAX_TRANSLATION) throw new PacketError("motion: a correction that cannot be");
  }
  return { groups, moving, number, symbols, translationStep, rotationStep, predicted: (flags & PREDICTED) !== 0 };
}

/** Rows of one cell of a grid and of one class of brightness are a group; groups are numbered by cell, then class. */
function formGroups({ means, sh0 }, cell, bins) {
  const number = means.length / 3;
  const keys = new Float64Array(number);
  const index = (value) => Math.min(Math.max(Math.floor(value / cell), -HALF_GRID), HALF_GRID - 1) + HALF_GRID;
  for (let i = 0; i < number; i += 1) {
    const bright = 0.5 + SH0 * (0.25 * sh0[3 * i] + 0.5 * sh0[3 * i + 1] + 0.25 * sh0[3 * i + 2]);
    const shade = Math.min(Math.max(Math.floor(bright * bins), 0), bins - 1);
    const place = (index(means[3 * i]) * 2 * HALF_GRID + index(means[3 * i + 1])) * 2 * HALF_GRID;
    keys[i] = (place + index(means[3 * i + 2])) * MAX_BINS + shade;
  }
  return { cell, bins, ...ranked(keys) };
}

/** The rank of every key among the distinct ones, and how many of these there are. */
function ranked(keys) {
  const groupOf = new Int32Array(keys.length);
  const found = new Map();
  const distinct = [];
  for (let i = 0; i < keys.length; i += 1) {
    // Neighbours in storage often are neighbours in space.
    if (i > 0 && keys[i] === keys[i - 1]) {
      groupOf[i] = groupOf[i - 1];
      continue;
    }
    let name = found.get(keys[i]);
    if (name === undefined) {
      name = distinct.length;
      found.set(keys[i], name);
      distinct.push(keys[i]);
    }
    groupOf[i] = name;
  }
  const rank = new Int32Array(distinct.length);
  Float64Array.from(distinct).sort().forEach((key, i) => {
    rank[found.get(key)] = i;
  });
  for (let i = 0; i < groupOf.length; i += 1) groupOf[i] = rank[groupOf[i]];
  return { groupOf, count: distinct.length };
}

/** Move the rows of moving groups, which are returned, in place, in float64 and in the format's order of operations. */
function applyTransforms(scene, motion, displacement) {
  const { groups, moving, number } = motion;
  const rank = new Int32Array(groups.count).fill(-1);
  for (let group = 0, k = 0; group < moving.length; group += 1) if (moving[group]) rank[group] = k++;
  const { means, quats } = scene;
  const { groupOf } = groups;
  const own = new Float64Array(3 * number);
  const counts = new Int32Array(number);
  const rows = new Uint32Array(groupOf.length);
  let found = 0;
  for (let row = 0; row < groupOf.length; row += 1) {
    const k = rank[groupOf[row]];
    if (k < 0) continue;
    rows[found++] = row;
    counts[k] += 1;
    own[3 * k] += means[3 * row];
    own[3 * k + 1] += means[3 * row + 1];
    own[3 * k + 2] += means[3 * row + 2];
  }
  divide(own, counts);
  const { translation, rotation } = transforms(motion, displacement, rank);
  const rotations = rodriguesToQuat(rotation);
  for (let i = 0; i < found; i += 1) {
    const row = rows[i];
    const k = rank[groupOf[row]];
    transformMean(means, row, rotations, own, translation, k);
    rotateQuat(quats, row, rotations, k);
  }
  return rows.subarray(0, found);
}

function divide(sums, counts) {
  for (let i = 0; i < sums.length; i += 1) sums[i] /= Math.max(counts[(i / 3) | 0], 1);
}

/** Translation and rotation of every moving group: the mean displacement of its rows in the last frame, corrected. */
function transforms({ groups, number, symbols, translationStep, rotationStep, predicted }, displacement, rank) {
  const translation = new Float64Array(3 * number);
  const rotation = new Float64Array(3 * number);
  if (predicted && displacement) {
    const counts = new Int32Array(number);
    for (let i = 0; i < displacement.rows.length; i += 1) {
      const k = rank[groups.groupOf[displacement.rows[i]]];
      if (k < 0) continue;
      counts[k] += 1;
      for (let axis = 0; axis < 3; axis += 1) {
        translation[3 * k + axis] += displacement.translation[3 * i + axis];
        rotation[3 * k + axis] += displacement.rotation[3 * i + axis];
      }
    }
    divide(translation, counts);
    divide(rotation, counts);
  }
  for (let k = 0; k < number; k += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      translation[3 * k + axis] += symbols[axis * number + k] * translationStep;
      rotation[3 * k + axis] += symbols[(3 + axis) * number + k] * rotationStep;
    }
  }
  return { translation, rotation };
}

/** Unit quaternions wxyz of rotations given as axis * tan(angle / 2). */
export function rodriguesToQuat(rotation) {
  const out = new Float64Array((rotation.length / 3) * 4);
  for (let k = 0; 3 * k < rotation.length; k += 1) {
    const [x, y, z] = rotation.subarray(3 * k, 3 * k + 3);
    const scale = 1 / Math.sqrt(1 + x * x + y * y + z * z);
    out.set([scale, x * scale, y * scale, z * scale], 4 * k);
  }
  return out;
}

function transformMean(means, row, quats, centre, translation, k) {
  const w = quats[4 * k];
  const x = quats[4 * k + 1];
  const y = quats[4 * k + 2];
  const z = quats[4 * k + 3];
  const d0 = means[3 * row] - centre[3 * k];
  const d1 = means[3 * row + 1] - centre[3 * k + 1];
  const d2 = means[3 * row + 2] - centre[3 * k + 2];
  const t0 = (1 - 2 * (y * y + z * z)) * d0 + 2 * (x * y - w * z) * d1 + 2 * (x * z + w * y) * d2;
  const t1 = 2 * (x * y + w * z) * d0 + (1 - 2 * (x * x + z * z)) * d1 + 2 * (y * z - w * x) * d2;
  const t2 = 2 * (x * z - w * y) * d0 + 2 * (y * z + w * x) * d1 + (1 - 2 * (x * x + y * y)) * d2;
  means[3 * row] = t0 + centre[3 * k] + translation[3 * k];
  means[3 * row + 1] = t1 + centre[3 * k + 1] + translation[3 * k + 1];
  means[3 * row + 2] = t2 + centre[3 * k + 2] + translation[3 * k + 2];
  // Zero times infinity is no number.
  if (0 * means[3 * row] + 0 * means[3 * row + 1] + 0 * means[3 * row + 2] !== 0) {
    throw new PacketError("motion: it leads to positions beyond the range of float32");
  }
}

export function rotateQuat(values, row, quats, k) {
  const w0 = quats[4 * k];
  const x0 = quats[4 * k + 1];
  const y0 = quats[4 * k + 2];
  const z0 = quats[4 * k + 3];
  const w1 = values[4 * row];
  const x1 = values[4 * row + 1];
  const y1 = values[4 * row + 2];
  const z1 = values[4 * row + 3];
  values[4 * row] = w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1;
  values[4 * row + 1] = w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1;
  values[4 * row + 2] = w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1;
  values[4 * row + 3] = w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1;
}
