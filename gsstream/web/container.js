// The container: file header, packet headers, sections and their checksums (chapter 1 of docs/spec).

import { PacketError } from "./errors.js";
import { ATTRIBUTES, FORMAT_MAJOR, FORMAT_MINOR, MAX_BODY, MAX_SECTIONS } from "./limits.js";

export const FILE_HEADER = 16;
export const PACKET_HEADER = 16;
export const SECTION_HEADER = 5;
const MAGIC = [0x89, 0x47, 0x53, 0x53, 0x0d, 0x0a, 0x1a, 0x0a];

export const KIND = { key: 1, delta: 2, empty: 3, index: 4 };
export const KIND_NAMES = { 1: "key", 2: "delta", 3: "empty", 4: "index" };
const SECTION_NAMES = [
  ...",meta,layout,gates,decoders,index,removed,added,motion,pattern,field,layers,rest,light,,".split(","),
  ...ATTRIBUTES,
];

const CRC_TABLE = new Uint32Array(256).map((_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit += 1) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});

/** CRC-32 as zlib computes it; `start` continues an earlier one. */
export function crc32(data, start = 0) {
  let crc = ~start;
  for (let i = 0; i < data.length; i += 1) crc = CRC_TABLE[(crc ^ data[i]) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

export function viewOf(data) {
  return new DataView(data.buffer, data.byteOffset, data.byteLength);
}

/** The format version of a stream's 16 header bytes, "major.minor". Throws PacketError unless it can be read here. */
export function checkFileHeader(data) {
  if (data.length < FILE_HEADER) {
    throw new PacketError(`not a gsstream file: expected ${FILE_HEADER} header bytes, got ${data.length}`, 0);
  }
  if (MAGIC.some((byte, i) => data[i] !== byte)) {
    throw new PacketError("not a gsstream file: it does not begin as one", 0);
  }
  const view = viewOf(data);
  const major = view.getUint16(8, true);
  const minor = view.getUint16(10, true);
  if (view.getUint32(12, true) !== crc32(data.subarray(0, 12))) {
    throw new PacketError("the file header is damaged: its checksum does not match", 8);
  }
  if (major !== FORMAT_MAJOR || minor > FORMAT_MINOR) {
    const what = major < FORMAT_MAJOR ? "older" : "newer";
    throw new PacketError(
      `packet format ${major}.${minor} cannot be read: it is ${what} than this player, which reads ` +
        `${FORMAT_MAJOR}.0 to ${FORMAT_MAJOR}.${FORMAT_MINOR}`,
      8,
    );
  }
  return `${major}.${minor}`;
}

/** The fixed header at the start of `data`, which lies at `offset` of the file. Throws PacketError. */
export function parseHeader(data, offset) {
  if (data.length < PACKET_HEADER) {
    throw new PacketError(`packet header cut short: expected ${PACKET_HEADER} bytes, got ${data.length}`, offset);
  }
  const view = viewOf(data);
  const header = {
    kind: data[0],
    sections: data[1],
    frame: view.getUint32(4, true),
    body: view.getUint32(8, true),
    checksum: view.getUint32(12, true),
  };
  if (view.getUint16(2, true) !== (crc32(data.subarray(4, 16), crc32(data.subarray(0, 2))) & 0xffff)) {
    throw new PacketError("packet header damaged: its check does not match", offset);
  }
  if (!KIND_NAMES[header.kind]) throw new PacketError(`unknown packet type ${header.kind}; expected 1 to 4`, offset);
  if (header.sections > MAX_SECTIONS || header.body > MAX_BODY || header.body < header.sections * SECTION_HEADER) {
    throw new PacketError(`packet header impossible: ${header.sections} sections in ${header.body} bytes`, offset);
  }
  return header;
}

/**
 * Check a complete packet and split it: `{ header, sections }`, see splitSections.
 *
 * Throws PacketError with the byte of the file.
 */
export function parsePacket(data, offset) {
  const header = parseHeader(data, offset);
  const body = data.subarray(PACKET_HEADER);
  if (body.length !== header.body) {
    throw new PacketError(`packet body: expected ${header.body} bytes, got ${body.length}`, offset);
  }
  if (crc32(body, crc32(data.subarray(4, 12), crc32(data.subarray(0, 2)))) !== header.checksum) {
    throw new PacketError(`packet of frame ${header.frame} is damaged: its checksum does not match`, offset);
  }
  return { header, sections: splitSections(header.sections, body, offset + PACKET_HEADER) };
}

/** The numbers of a packet's sections, before it is checked. */
export function* sectionsOf(data) {
  const view = viewOf(data);
  for (let at = PACKET_HEADER; at + SECTION_HEADER <= data.length; at += SECTION_HEADER + view.getUint32(at + 1, true)) {
    yield data[at];
  }
}

/** The `number` sections of `body` in file order, name -> `{ data, offset }`; `start`: its place in the file. */
export function splitSections(number, body, start) {
  const view = viewOf(body);
  const sections = {};
  let at = 0;
  for (let i = 0; i < number; i += 1) {
    if (at + SECTION_HEADER > body.length) {
      throw new PacketError("section header runs past the end of its packet", start + at);
    }
    const name = SECTION_NAMES[body[at]];
    const length = view.getUint32(at + 1, true);
    if (!name) throw new PacketError(`section ${body[at]} is unknown: a newer player is needed`, start + at);
    if (sections[name]) throw new PacketError(`section ${name} is repeated`, start + at);
    at += SECTION_HEADER;
    if (length > body.length - at) {
      throw new PacketError(
        `section ${name}: ${length} bytes announced, ${body.length - at} left in the packet`,
        start + at,
      );
    }
    sections[name] = { data: body.subarray(at, at + length), offset: start + at };
    at += length;
  }
  if (at !== body.length) throw new PacketError(`${body.length - at} bytes after the last section`, start + at);
  return sections;
}

/** [{ frame, offset }] of every key packet, from a complete index packet at `offset`. Throws PacketError. */
export function parseIndex(data, offset) {
  const { sections } = parsePacket(data, offset);
  if (`${Object.keys(sections)}` !== "index") {
    throw new PacketError("index packet: expected the section index alone", offset);
  }
  const section = sections.index;
  const size = section.data.length - 12;
  if (size < 0 || size % 12) throw new PacketError(`index of ${section.data.length} bytes cannot be`, section.offset);
  const view = viewOf(section.data);
  const own = Number(view.getBigUint64(size, true));
  if (own !== offset || String.fromCharCode(...section.data.subarray(size + 8)) !== "GSSX") {
    throw new PacketError("index trailer does not point at its packet", section.offset + size);
  }
  const keys = [];
  for (let at = 0; at < size; at += 12) {
    keys.push({ frame: view.getUint32(at, true), offset: Number(view.getBigUint64(at + 4, true)) });
  }
  return keys;
}
