// The meta of a key packet: what a player reads of it, checked as chapter 3 of docs/spec says.

import { PacketError } from "./errors.js";

const MAX_DEPTH = 100;
const [MIN_FPS, MAX_FPS] = [0.01, 100000];
const [MAX_SIDE, MAX_PIXELS] = [1 << 16, 1 << 27];
const MAX_NAME_BYTES = 120;

/** The meta that bytes of JSON hold. Throws PacketError where what a player reads is not as it must be. */
export function parseMeta(data) {
  const value = parse(data);
  if (!isObject(value)) throw new PacketError("meta: expected an object");
  const { train, test, fps, background } = value;
  if (!isNumber(fps) || fps < MIN_FPS || fps > MAX_FPS) {
    throw new PacketError(`meta: fps: expected ${MIN_FPS} to ${MAX_FPS} frames per second`);
  }
  if (!isSingles(background, 3)) throw new PacketError("meta: background: expected three finite numbers");
  for (const [name, rig] of Object.entries({ train, test })) {
    const fault = rigFault(rig);
    if (fault) throw new PacketError(`meta: ${name}: ${fault}`);
  }
  if (!train.ids.length && !test.ids.length) throw new PacketError("meta: there is no camera");
  if ("world" in value && !isWorld(value.world)) {
    throw new PacketError("meta: world: expected a rotation, an offset and a scale above 0");
  }
  return value;
}

function parse(data) {
  if (nestedTooDeep(data)) throw new PacketError(`meta: arrays and objects lie more than ${MAX_DEPTH} deep`);
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(data));
  } catch (error) {
    throw new PacketError(`meta: not what was expected: ${error.message}`);
  }
}

/** Whether brackets lie too deep within each other, by the bytes alone: what a parser builds takes far more memory. */
function nestedTooDeep(data) {
  let depth = 0;
  let text = false;
  for (let i = 0; i < data.length; i += 1) {
    const sign = data[i];
    if (sign === 0x22) text = !text;
    else if (text) i += sign === 0x5c;
    else if (sign === 0x5b || sign === 0x7b) depth += 1;
    else if (sign === 0x5d || sign === 0x7d) depth -= 1;
    if (depth > MAX_DEPTH) return true;
  }
  return false;
}

const isObject = (value) => value !== null && typeof value === "object" && !Array.isArray(value);
const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
const isSingle = (value) => isNumber(value) && Number.isFinite(Math.fround(value));
const isSingles = (list, length) => Array.isArray(list) && list.length === length && list.every(isSingle);
const isAbove0 = (value) => isSingle(value) && Math.fround(value) > 0;
const is = (values, wanted, by) => values.every((value, i) => Math.abs(value - wanted[i]) <= by);

/** Why cameras cannot be; null when they can. */
function rigFault(rig) {
  if (!isObject(rig) || ![rig.ids, rig.viewmats, rig.Ks].every(Array.isArray)) return "expected cameras";
  const { ids, width, height, near, viewmats, Ks } = rig;
  if (![width, height].every((side) => Number.isInteger(side) && side >= 1 && side <= MAX_SIDE)) return "image size";
  if (width * height > MAX_PIXELS) return `image size: expected at most ${MAX_PIXELS} pixels`;
  if (!isAbove0(near)) return "near: expected a number above 0";
  if (viewmats.length !== ids.length || Ks.length !== ids.length) return "expected a pose and a K for each id";
  if (new Set(ids).size !== ids.length || !ids.every(isName)) return "ids: expected different names of folders";
  if (!viewmats.every(isPose)) return "viewmats: expected rotations and translations";
  return Ks.every(isPinhole) ? null : "Ks: expected focal lengths above 0, no skew, the last row 0 0 1";
}

const SIGNS = /[/\\:\u0000-\u001f\u007f-\u009f\u2028\u2029\p{Surrogate}]/u;
const DEVICE = /^(con|prn|aux|nul|(com|lpt)[1-9])(\.|$)/i;

/** Whether a text can be the name of one folder on every system. */
function isName(id) {
  if (typeof id !== "string" || SIGNS.test(id) || DEVICE.test(id) || /^$|[. ]$/.test(id)) return false;
  return new TextEncoder().encode(id).length <= MAX_NAME_BYTES;
}

function isPose(m) {
  if (!isSingles(m, 16)) return false;
  const axes = [m.slice(0, 3), m.slice(4, 7), m.slice(8, 11)].flat();
  return isRotation(axes, 1e-3) && is(m.slice(12), [0, 0, 0, 1], 1e-6);
}

function isPinhole(K) {
  if (!isSingles(K, 9) || !isAbove0(K[0]) || !isAbove0(K[4])) return false;
  const skewed = Math.abs(K[1]) > 1e-6 * K[0] || Math.abs(K[3]) > 1e-6 * K[4];
  return !skewed && is(K.slice(6), [0, 0, 1], 1e-6) && Math.abs(determinant(K)) >= 1e-12;
}

function isRotation(m, by) {
  const rows = [0, 3, 6].map((at) => m.slice(at, at + 3));
  const across = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const square = rows.every((a, i) => rows.every((b, k) => Math.abs(across(a, b) - (i === k)) <= by));
  return square && determinant(m) >= 0;
}

function determinant([a, b, c, d, e, f, g, h, i]) {
  return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
}

/** Whether a value is a similarity: a rotation row by row, an offset and a scale above 0, all of them finite. */
export function isWorld(value) {
  if (!isObject(value)) return false;
  const { rotation, offset, scale } = value;
  const numbers = [rotation, offset].every((list) => Array.isArray(list) && list.every(isNumber));
  if (!numbers || rotation.length !== 9 || offset.length !== 3) return false;
  return isNumber(scale) && scale > 0 && isRotation(rotation, 1e-6);
}
