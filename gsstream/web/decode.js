// The state that a stream of packets leads to, bit for bit the one of the encoder. See docs/reference/packet-format.md.

import { applyResidual, decodeResidual, SECTIONS as RESIDUAL } from "./changes/residual.js";
import { applyRows, decodeRows, SECTIONS as ROWS } from "./changes/rows.js";
import { KIND, KIND_NAMES, parsePacket } from "./container.js";
import { PacketError } from "./errors.js";
import { decodeKey } from "./key.js";
import { ATTRIBUTES } from "./limits.js";

/**
 * The state after one complete packet at byte `offset` of its file.
 *
 * `state` is that of the frame before (null is fine for a key packet). A delta changes it in place and returns it: it is
 * decoded as a whole first, so after a PacketError the state still is that of the frame before.
 *
 * A state has `frame`, `number` (Gaussians), `scene` (attribute -> Float32Array), `widths` (values a row), `layout`,
 * `meta`, `decoders`, and `change`: what this packet did, for whoever shows it.
 */
export function decodePacket(state, data, offset = 0) {
  const { header, sections } = parsePacket(data, offset);
  if (header.kind === KIND.key) return keyState(header, sections, data.length, offset);
  if (header.kind === KIND.index) throw new PacketError("expected a frame's packet, got the index", offset);
  if (state === null || header.frame !== state.frame + 1) {
    const had = state === null ? "none" : `frame ${state.frame}`;
    throw new PacketError(`frame ${header.frame} needs the state of the frame before it, got ${had}`, offset);
  }
  if (header.kind === KIND.empty) {
    if (sections.length) throw new PacketError("empty packet with sections", offset);
    state.change = { kind: "empty" };
  } else {
    state.change = applyDelta(state, decodeDelta(sections, state, offset));
  }
  state.frame = header.frame;
  return state;
}

function keyState(header, sections, size, offset) {
  const { scene, layout, meta } = decodeKey(sections, size, offset);
  const number = layout.unitOf.length;
  const widths = { means: 3, quats: 4, scales: 3, opacities: 1, sh0: 3, shN: number ? scene.shN.length / number : 0 };
  return {
    frame: header.frame, number, scene, widths, layout, meta, decoders: new Map(), change: { kind: KIND_NAMES[KIND.key] },
  };
}

function decodeDelta(sections, state, offset) {
  const found = Object.fromEntries(sections.map((section) => [section.name, section]));
  const known = [...RESIDUAL, ...ROWS];
  if (!found.gates || sections.some(({ name }) => !known.includes(name))) {
    throw new PacketError(`delta packet: unexpected sections ${sections.map((s) => s.name)}`, offset);
  }
  const residual = decodeResidual(found, state, offset);
  const rows = found.deaths || found.births ? decodeRows(found, state, offset) : null;
  return { residual, rows };
}

/**
 * Apply what was decoded, in order. Returns what changed: `moved`, rows with their gates as they were numbered before
 * births and deaths, and `source`, the row each row was before (null when none joined or left; see `applyRows`).
 */
function applyDelta(state, { residual, rows }) {
  applyResidual(state, residual);
  const moved = [
    { rows: residual.rows, gate: residual.gate, attributes: residual.parts.map((part) => part.name) },
  ];
  if (!rows) return { kind: "delta", moved, source: null, before: state.number };
  const before = state.number;
  const source = applyRows(state, rows);
  state.number = source.length;
  return { kind: "delta", moved, source, before };
}

/** The bytes of all attributes in their order: two states are the same when these are. */
export function sceneBytes(state) {
  const arrays = ATTRIBUTES.map((name) => state.scene[name]);
  const out = new Uint8Array(arrays.reduce((sum, array) => sum + array.byteLength, 0));
  let at = 0;
  for (const array of arrays) {
    out.set(new Uint8Array(array.buffer, array.byteOffset, array.byteLength), at);
    at += array.byteLength;
  }
  return out;
}
