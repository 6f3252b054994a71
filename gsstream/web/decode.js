// The state that a stream of packets leads to, bit for bit the one of the encoder. See docs/spec.

import { copied as motionCopy, decodeMotions, unionRows, SECTIONS as MOTION } from "./changes/motion.js";
import { applyResidual, decodeResidual, SECTIONS as RESIDUAL } from "./changes/residual.js";
import { applyRows, decodeRows, SECTIONS as ROWS } from "./changes/rows.js";
import { KIND, parsePacket } from "./container.js";
import { PacketError, located } from "./errors.js";
import { displacementBetween, gatherDisplacement, gatherGroups, gatherValues } from "./history.js";
import { decodeKey, later } from "./key.js";

/**
 * The state after one complete packet at byte `offset` of its file.
 *
 * `state` is that of the frame before (null is fine for a key packet). A delta changes it in place and returns it: it
 * is decoded as a whole first, so after a PacketError the state still is that of the frame before.
 *
 * A state has `frame`, `number` (Gaussians), `scene` (attribute -> Float32Array), `widths` (values a row), `layout`,
 * `meta`, `background` (that of the meta until there is a light), `decoders`, `groups` and `displacement` (for the next packet),
 * `turned` (whether a motion or a light was since the key packet), `spare` (memory for motions), and `change`: what this packet changed, for the view.
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
    if (header.sections) throw new PacketError("empty packet with sections", offset);
    state.displacement = null;
    state.change = { kind: "empty" };
  } else {
    state.change = applyDelta(state, decodeDelta(sections, state, offset));
  }
  state.frame = header.frame;
  return state;
}

function keyState(header, sections, size, offset) {
  const decoded = decodeKey(sections, size, offset);
  return firstState(header.frame, decoded.layout.unitOf.length, decoded);
}

/** The state of a key packet, or of its first layer, which has no `layout`. */
export function firstState(frame, number, { scene, layout, meta, rest }) {
  const widths = { means: 3, quats: 4, scales: 3, opacities: 1, sh0: 3, shN: rest };
  const before = { decoders: new Map(), groups: null, displacement: null, turned: false, spare: null };
  return { frame, number, scene, widths, layout, meta, ...before, change: { kind: "key" } };
}

/** Sections of a delta packet in their order. */
const ORDER = ["light", ...MOTION, "field", ...RESIDUAL, ...ROWS];

function decodeDelta(found, state, offset) {
  const { field, motion, light } = found;
  const names = Object.keys(found);
  const places = names.map((name) => ORDER.indexOf(name));
  if (!places.length || places.some((place, i) => place < 0 || place < places[i - 1])) {
    throw new PacketError(`delta packet: sections ${names.join(", ") || "none"} do not stand in this order`, offset);
  }
  const lit = light && located(light.offset, () => later.light(light.data, state));
  if (lit) state = lit.state;
  let motions = motion && located(motion.offset, () => decodeMotions(motion, state));
  if (field) {
    motions ??= { ...motionCopy(state), groups: state.groups, rows: [] };
    motions = located(field.offset, () => later.field(field, motions));
  }
  const stray = names.find((name) => RESIDUAL.includes(name));
  if (stray && !found.gates) throw new PacketError(`delta packet: section ${stray} without gates`, found[stray].offset);
  const residual = found.gates && decodeResidual(found, state, offset);
  const rows = found.removed || found.added ? decodeRows(found, state, offset) : null;
  return { lit, motions, residual, rows };
}

/**
 * Apply what was decoded, in order. Returns `moved`, lists of changed rows as numbered before, with gates and
 * attributes, and `source` of `applyRows` (null without added and removed rows).
 */
function applyDelta(state, { lit, motions, residual, rows }) {
  const touched = unionRows(motions?.rows ?? [], residual?.rows ?? []);
  const means = gatherValues(state.scene.means, touched, 3);
  const quats = gatherValues(state.scene.quats, touched, 4);
  const change = { kind: "delta", moved: [], source: null, before: state.number };
  lit?.apply(state, change);
  if (motions) {
    const { means, quats } = state.scene;
    state.spare = { means, quats, rows: touched };
    Object.assign(state.scene, { means: motions.means, quats: motions.quats });
    state.groups = motions.groups;
    state.turned = true;
    change.moved.push({ rows: motions.rows, gate: null, attributes: ["means", "quats"] });
  }
  if (residual) {
    if (!motions) state.spare = null;
    applyResidual(state, residual);
    const attributes = residual.parts.map((part) => part.name);
    change.moved.push({ rows: residual.rows, gate: residual.gate, attributes });
  }
  state.displacement = displacementBetween(touched, means, quats, state.scene);
  if (rows) {
    state.spare = null;
    change.source = applyRows(state, rows);
    state.displacement = gatherDisplacement(state.displacement, change.source, change.before);
    state.groups = gatherGroups(state.groups, change.source, change.before);
    state.number = change.source.length;
  }
  return change;
}

/** A copy of a state that later packets do not touch. */
export function copied(state) {
  const scene = Object.fromEntries(Object.entries(state.scene).map(([name, values]) => [name, values.slice()]));
  return { ...state, scene, decoders: new Map(state.decoders), spare: null };
}
