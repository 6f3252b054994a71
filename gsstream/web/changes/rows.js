// Births and deaths: rows that leave the scene, and rows that join it behind the last row of their node.

import { decodeAttributes } from "../attributes.js";
import { BitReader, unpackParts } from "../bits.js";
import { PacketError, located } from "../errors.js";
import { decodeUnits } from "../key.js";
import { ATTRIBUTES, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE } from "../limits.js";
import { decodeGates, decodeSymbols } from "../symbols.js";

/** Sections that this change is made of. */
export const SECTIONS = ["deaths", "births"];

const HEAD_PARTS = 5;

/**
 * Decode births and deaths from sections by name. Nothing of `state` changes.
 *
 * Returns `{ gone: Uint8Array [N] or null, births: { number, counts, nodes, unitOf, scene } or null }`; `counts` is the
 * number of births of each of the `nodes` nodes there are afterwards.
 */
export function decodeRows(sections, state, offset) {
  const number = state.layout.unitOf.length;
  const gone = sections.deaths
    ? located(sections.deaths.offset, () => decodeDeaths(sections.deaths.data, number))
    : null;
  let births = null;
  if (sections.births) {
    const leaving = gone ? gone.reduce((sum, flag) => sum + flag, 0) : 0;
    const most = MAX_GAUSSIANS - (number - leaving);
    births = located(sections.births.offset, () => decodeBirths(sections.births, state.layout, most));
    checkWidths(births, state, offset);
  }
  return { gone, births };
}

function decodeDeaths(data, number) {
  const { gates, levels } = decodeGates(data, number);
  if (levels !== 1 || !gates.includes(1)) throw new PacketError("deaths: no row leaves, or rows leave by levels");
  return gates;
}

function decodeBirths({ data, offset }, layout, most) {
  const nodes = layout.counts.length;
  const parts = unpackParts(data, HEAD_PARTS + ATTRIBUTES.length);
  const head = new BitReader(parts[0]);
  const number = head.gamma() + 1;
  const added = head.gamma();
  head.finish();
  const allowed = Math.min(MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE * data.length);
  if (number > Math.min(allowed, most) || added > Math.min(allowed, MAX_GAUSSIANS - nodes)) {
    throw new PacketError(`births of ${number} Gaussians and ${added} nodes are beyond the limits`);
  }
  const up = decodeSymbols(parts[1], added, 1);
  for (let i = 0; i < added; i += 1) {
    if (up[i] < 0 || up[i] > nodes + i) throw new PacketError("births: a parent that is no node before its own");
  }
  const used = decodeGates(parts[2], nodes + added);
  const open = used.gates.reduce((sum, gate) => sum + (gate > 0), 0);
  const sizes = decodeSymbols(parts[3], open, 1);
  const sum = sizes.reduce((total, size) => total + size, 0);
  if (used.levels !== 1 || sizes.some((size) => size < 1) || sum !== number) {
    throw new PacketError(`births: nodes receive ${sum} Gaussians, ${number} were announced`);
  }
  const counts = new Int32Array(nodes + added);
  for (let node = 0, k = 0; node < counts.length; node += 1) if (used.gates[node]) counts[node] = sizes[k++];
  const unitOf = decodeUnits(parts[4], number, layout.units.length);
  const rows = Object.fromEntries(ATTRIBUTES.map((name, i) => [name, { data: parts[HEAD_PARTS + i], offset }]));
  return { number, counts, unitOf, scene: decodeAttributes(rows, number) };
}

function checkWidths(births, state, offset) {
  for (const name of ATTRIBUTES) {
    if (births.scene[name].length / births.number !== state.widths[name]) {
      throw new PacketError(`births: expected ${state.widths[name]} values of ${name} like the scene`, offset);
    }
  }
}

/**
 * Let rows leave and join, in place. Returns [N'] the row that each row was before; N + j is birth j.
 */
export function applyRows(state, { gone, births }) {
  const { layout, scene, widths } = state;
  const source = gatherRows(layout, gone, births);
  for (const name of ATTRIBUTES) {
    scene[name] = gather(scene[name], births && births.scene[name], source, widths[name], layout.unitOf.length);
  }
  const unitOf = gather(layout.unitOf, births && births.unitOf, source, 1, layout.unitOf.length);
  state.layout = { counts: nextCounts(layout, gone, births), unitOf, units: layout.units };
  return source;
}

function gatherRows({ counts, unitOf }, gone, births) {
  const source = new Uint32Array(unitOf.length + (births ? births.number : 0));
  const nodes = births ? births.counts.length : counts.length;
  let at = 0;
  let born = unitOf.length;
  for (let node = 0, row = 0; node < nodes; node += 1) {
    const end = node < counts.length ? row + counts[node] : row;
    for (; row < end; row += 1) if (!gone || !gone[row]) source[at++] = row;
    for (let k = births ? births.counts[node] : 0; k > 0; k -= 1) source[at++] = born++;
  }
  return source.slice(0, at);
}

function nextCounts({ counts }, gone, births) {
  const out = new Int32Array(births ? births.counts.length : counts.length);
  if (births) out.set(births.counts);
  for (let node = 0, row = 0; node < counts.length; node += 1) {
    const end = row + counts[node];
    out[node] += counts[node];
    if (gone) for (let k = row; k < end; k += 1) out[node] -= gone[k];
    row = end;
  }
  return out;
}

/** Rows of one attribute in their new places, copied run by run. */
function gather(old, born, source, width, number) {
  const out = new old.constructor(source.length * width);
  let start = 0;
  while (start < source.length) {
    let stop = start + 1;
    while (stop < source.length && source[stop] === source[stop - 1] + 1 && source[stop] !== number) stop += 1;
    const from = source[start] < number ? old : born;
    const row = source[start] < number ? source[start] : source[start] - number;
    out.set(from.subarray(row * width, (row + stop - start) * width), start * width);
    start = stop;
  }
  return out;
}
