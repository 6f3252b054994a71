// Joins: the state in the middle of a segment, said as what differs from its key packet, bit for bit. The layout of the
// bytes is in docs/reference/package-format.md.

import { crc32 } from "./container.js";
import { PacketError } from "./errors.js";
import { inflate } from "./key.js";
import { ATTRIBUTES, MAX_GAUSSIANS } from "./limits.js";

const MAGIC = 0x4a535347;
const VERSION = 1;
const HEADER = 24;
const MAX_BYTES = 2 ** 30;

/**
 * The state before frame `frame`, from `key`, a state after the key packet of its segment, which is used up.
 *
 * Throws PacketError when the file is damaged or belongs to another key packet.
 */
export function decodeJoin(key, data) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  if (data.length < HEADER || view.getUint32(0, true) !== MAGIC) throw new PacketError("not a join of a package", 0);
  const [version, keyFrame, frame, size, checksum] = [4, 8, 12, 16, 20].map((at) => view.getUint32(at, true));
  const packed = data.subarray(HEADER);
  if (version !== VERSION || keyFrame !== key.frame || packed.length !== size || crc32(packed) !== checksum) {
    throw new PacketError(`join of frame ${frame} is damaged, of another version, or of another key packet`, 4);
  }
  const body = new Body(inflate(packed, MAX_BYTES));
  const facts = body.facts();
  const { number } = facts;
  if (!(number >= 0 && number <= MAX_GAUSSIANS)) throw new PacketError(`join of ${number} Gaussians cannot be`);
  const source = facts.rows && body.steps(number);
  const layout = { ...key.layout };
  if (facts.rows) Object.assign(layout, { counts: body.int32(facts.rows.nodes), unitOf: body.bytes(number) });
  const scene = {};
  for (const name of ATTRIBUTES) {
    scene[name] = changed(key.scene[name], key.widths[name], source, number, facts.changed[name], body);
  }
  const decoders = new Map();
  for (const [name, [latents, width]] of Object.entries(facts.decoders)) {
    decoders.set(name, { latents, width, values: new Float32Array(body.int32(latents * width).buffer) });
  }
  const groups = facts.groups && { ...facts.groups, groupOf: body.steps(number) };
  const displacement = facts.displaced === null ? null : body.displacement(facts.displaced);
  const change = { kind: "key" };
  return { ...key, background: facts.background, frame, number, scene, layout, decoders, groups, displacement, turned: true, change };
}

/** The values of one attribute: those of the key packet, plus differences of their bits. */
function changed(values, width, source, number, count, body) {
  const marks = body.bytes((number + 7) >> 3);
  const planes = body.bytes(4 * count * width);
  const before = new Int32Array(values.buffer, values.byteOffset, values.length);
  const out = source ? new Int32Array(number * width) : before;
  if (out.length !== number * width) throw new PacketError("join: the scene of its key packet has other rows");
  const rows = new Uint32Array(count);
  for (let row = 0, at = 0; row < number; row += 1) {
    const from = source ? source[row] * width : -1;
    if (from >= 0) out.set(before.subarray(from, from + width), row * width);
    if ((marks[row >> 3] >> (7 - (row & 7))) & 1) rows[at++] = row;
  }
  for (let i = 0; i < count * width; i += 1) out[rows[i % count] * width + Math.floor(i / count)] += folded(planes, i);
  return new Float32Array(out.buffer, out.byteOffset, out.length);
}

/** Value `i` of bytes by significance, whose sign is in the lowest bit. */
function folded(planes, i) {
  const step = planes.length >> 2;
  const value = planes[i] | (planes[i + step] << 8) | (planes[i + 2 * step] << 16) | (planes[i + 3 * step] << 24);
  return (value >>> 1) ^ -(value & 1);
}

/** Takes arrays from bytes, one after the other. */
class Body {
  constructor(data) {
    this.data = data;
    this.at = 0;
  }

  bytes(size) {
    if (!(size >= 0 && size <= this.data.length - this.at)) {
      throw new PacketError(`join: ${size} bytes announced, ${this.data.length - this.at} left`);
    }
    this.at += size;
    return this.data.slice(this.at - size, this.at);
  }

  int32(count) {
    return new Int32Array(this.bytes(4 * count).buffer);
  }

  facts() {
    const [size] = this.int32(1);
    try {
      return JSON.parse(new TextDecoder().decode(this.bytes(size)));
    } catch {
      throw new PacketError("join: it does not say what it holds");
    }
  }

  /** Values of which the differences, less one, are stored. */
  steps(count) {
    const out = this.int32(count);
    for (let i = 0, last = -1; i < count; i += 1) {
      last += out[i] + 1;
      out[i] = last;
    }
    return out;
  }

  /** [count, 3] float32 of which the bits are stored by significance. */
  floats(count) {
    const planes = this.bytes(12 * count);
    const out = new Int32Array(3 * count);
    for (let i = 0; i < 3 * count; i += 1) out[3 * (i % count) + Math.floor(i / count)] = folded(planes, i);
    return new Float32Array(out.buffer);
  }

  displacement(count) {
    const rows = Uint32Array.from(this.steps(count));
    return { rows, translation: this.floats(count), rotation: this.floats(count) };
  }
}
