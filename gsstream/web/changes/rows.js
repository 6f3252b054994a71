// Added and removed Gaussians: rows that leave the scene, and rows that join it behind the last row of their node.

import { decodeAttributes } from "../attributes.js";
import { BitReader, unpackParts } from "../bits.js";
import { PacketError, ofSection } from "../errors.js";
import { decodeUnits } from "../key.js";
import { ATTRIBUTES, checkMemory, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE } from "../limits.js";
import { decodeGates, decodeSymbols } from "../symbols.js";

/** Sections that this change is made of. */
export const SECTIONS = ["removed", "added"];

const HEAD_PARTS = 5;

/**
 * Decode added and removed rows from sections by name. Nothing of `state` changes.
 *
 * Returns `{ removed: Uint8Array [N] or null, added: { number, counts, unitOf, scene } or null }`; `counts`: Gaussians
 * added to each node there is afterwards.
 */
export function decodeRows(sections, state, offset) {
  const number = state.layout.unitOf.length;
  const removed = ofSection(sections.removed, (data) => decodeRemoved(data, number));
  const leaving = removed ? removed.reduce((sum, flag) => sum + flag, 0) : 0;
  const most = MAX_GAUSSIANS - (number - leaving);
  const added = ofSection(sections.added, () => decodeAdded(sections.added, state.layout, most));
  if (added) checkWidths(added, state, offset);
  return { removed, added };
}

function decodeRemoved(data, number) {
  const { gates, levels } = decodeGates(data, number);
  if (levels !== 1 || !gates.includes(1)) throw new PacketError("removed: no row leaves, or rows leave by levels");
  return gates;
}

function decodeAdded({ data, offset }, layout, most) {
  const nodes = layout.counts.length;
  const parts = unpackParts(data, HEAD_PARTS + ATTRIBUTES.length);
  const head = new BitReader(parts[0]);
  const number = head.gamma() + 1;
  const newNodes = head.gamma();
  head.finish();
  const allowed = Math.min(MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE * data.length);
  if (number > Math.min(allowed, most) || newNodes > Math.min(allowed, MAX_GAUSSIANS - nodes)) {
    throw new PacketError(`added: ${number} Gaussians and ${newNodes} nodes are beyond the limits`);
  }
  checkMemory(layout.unitOf.length + number, 14 + Math.min(45, parts.at(-1)[1] ?? 0), offset + data.length);
  const up = decodeSymbols(parts[1], newNodes, 1);
  for (let i = 0; i < newNodes; i += 1) {
    if (up[i] < 0 || up[i] > nodes + i) throw new PacketError("added: a parent that is no node before its own");
  }
  const used = decodeGates(parts[2], nodes + newNodes);
  const open = used.gates.reduce((sum, gate) => sum + (gate > 0), 0);
  const sizes = decodeSymbols(parts[3], open, 1);
  const sum = sizes.reduce((total, size) => total + size, 0);
  if (used.levels !== 1 || sizes.some((size) => size < 1) || sum !== number) {
    throw new PacketError(`added: nodes receive ${sum} Gaussians, ${number} were announced`);
  }
  const counts = new Int32Array(nodes + newNodes);
  for (let node = 0, k = 0; node < counts.length; node += 1) if (used.gates[node]) counts[node] = sizes[k++];
  const unitOf = decodeUnits(parts[4], number, layout.units.length);
  const rows = Object.fromEntries(ATTRIBUTES.map((name, i) => [name, { data: parts[HEAD_PARTS + i], offset }]));
  return { number, counts, unitOf, scene: decodeAttributes(rows, number) };
}

function checkWidths(added, state, offset) {
  for (const name of ATTRIBUTES) {
    if (added.scene[name].length / added.number !== state.widths[name]) {
      throw new PacketError(`added: expected ${state.widths[name]} values of ${name} like the scene`, offset);
    }
  }
}

/** Remove and add rows, in place. Returns [N'] the row that each row was before; N + j is added row j. */
export function applyRows(state, { removed, added }) {
  const { layout, scene, widths } = state;
  const source = gatherRows(layout, removed, added);
  for (const name of ATTRIBUTES) {
    scene[name] = gather(scene[name], added && added.scene[name], source, widths[name], layout.unitOf.length);
  }
  const unitOf = gather(layout.unitOf, added && added.unitOf, source, 1, layout.unitOf.length);
  state.layout = { counts: nextCounts(layout, removed, added), unitOf, units: layout.units };
  return source;
}

function gatherRows({ counts, unitOf }, removed, added) {
  const source = new Uint32Array(unitOf.length + (added ? added.number : 0));
  const nodes = added ? added.counts.length : counts.length;
  let at = 0;
  let next = unitOf.length;
  for (let node = 0, row = 0; node < nodes; node += 1) {
    const end = node < counts.length ? row + counts[node] : row;
    for (; row < end; row += 1) if (!removed || !removed[row]) source[at++] = row;
    for (let k = added ? added.counts[node] : 0; k > 0; k -= 1) source[at++] = next++;
  }
  return source.slice(0, at);
}

function nextCounts({ counts }, removed, added) {
  const out = new Int32Array(added ? added.counts.length : counts.length);
  if (added) out.set(added.counts);
  for (let node = 0, row = 0; node < counts.length; node += 1) {
    const end = row + counts[node];
    out[node] += counts[node];
    if (removed) for (let k = row; k < end; k += 1) out[node] -= removed[k];
    row = end;
  }
  return out;
}

/** Rows of one attribute in their new places, copied run by run. */
function gather(old, added, source, width, number) {
  const out = new old.constructor(source.length * width);
  let start = 0;
  while (start < source.length) {
    let stop = start + 1;
    while (stop < source.length && source[stop] === source[stop - 1] + 1 && source[stop] !== number) stop += 1;
    const from = source[start] < number ? old : added;
    const row = source[start] < number ? source[start] : source[start] - number;
    out.set(from.subarray(row * width, (row + stop - start) * width), start * width);
    start = stop;
  }
  return out;
}
