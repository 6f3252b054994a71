// Key packets in two layers: first the Gaussians that a picture would miss most, then the rest of them.

import { decodeAttributes } from "./attributes.js";
import { unpackParts } from "./bits.js";
import { KIND, PACKET_HEADER, SECTION_HEADER, crc32, parseHeader, splitSections, viewOf } from "./container.js";
import { firstState } from "./decode.js";
import { PacketError, located } from "./errors.js";
import { decodeMeta, later, mostGaussians } from "./key.js";
import { ATTRIBUTES, checkMemory } from "./limits.js";
import { decodeSymbols } from "./symbols.js";

const HEAD = 12;
/** Byte of a packet with layers at which the first layer begins: header, section header, what section `layers` says. */
export const START = PACKET_HEADER + SECTION_HEADER + HEAD;

/** What section `layers` says: `[Gaussians of the first layer, bytes of the sections it takes, their CRC-32]`. */
export function headOf(data) {
  if (data.length !== HEAD) throw new PacketError(`layers: expected ${HEAD} bytes, got ${data.length}`);
  return [0, 4, 8].map((at) => viewOf(data).getUint32(at, true));
}

/** Decode the `number` Gaussians of both layers, as decodeAttributes does those of one. */
function decodeLayers(found, number) {
  const { layers, layout, rest } = found;
  const count = located(layers.offset, () => {
    const [inFirst, size, checksum] = headOf(layers.data);
    if (size !== layout.offset - SECTION_HEADER - layers.offset - HEAD || inFirst > number) {
      throw new PacketError(`layers: ${inFirst} of ${number} Gaussians in ${size} bytes cannot be`);
    }
    const { buffer, byteOffset } = layers.data;
    if (crc32(new Uint8Array(buffer, byteOffset + HEAD, size)) !== checksum) {
      throw new PacketError("layers: the checksum of the first layer does not match");
    }
    return inFirst;
  });
  const now = decodeAttributes(found, count);
  return located(rest.offset, () => merge(rest, found, now, count, number));
}

later.layers = decodeLayers;

function merge({ data, offset }, found, now, count, number) {
  const [marks, ...parts] = unpackParts(data, 1 + ATTRIBUTES.length);
  const first = decodeSymbols(marks, number, 1);
  const marked = first.reduce((sum, mark) => sum + mark, 0);
  if (marked !== count || first.some((mark) => mark >> 1)) {
    throw new PacketError(`rest: ${marked} Gaussians are marked, the first layer has ${count}`);
  }
  const named = Object.fromEntries(ATTRIBUTES.map((name, i) => [name, { data: parts[i], offset }]));
  const later = decodeAttributes(named, number - count);
  if (named.shN.data[1] !== found.shN.data[1]) {
    throw new PacketError("rest: shN is not as wide as in the first layer");
  }
  return Object.fromEntries(ATTRIBUTES.map((name) => [name, interleaved(first, [later[name], now[name]])]));
}

/** Rows of two arrays, row by row from the one that `which` says. */
function interleaved(which, sources) {
  const out = new Float32Array(sources[0].length + sources[1].length);
  const width = out.length / which.length;
  const at = [0, 0];
  for (let i = 0, to = 0; i < which.length; i += 1) {
    const from = which[i];
    for (const end = to + width; to < end; to += 1) out[to] = sources[from][at[from]++];
  }
  return out;
}

/**
 * The state, without a layout, that is to be drawn of the first bytes of a key packet; null while they are too few, and
 * when they are damaged or have no layers: whoever decodes the whole packet says what is wrong with it.
 */
export function firstLayer(data) {
  try {
    return data.length < START ? null : soundLayer(data);
  } catch (error) {
    if (error instanceof PacketError) return null;
    throw error;
  }
}

function soundLayer(data) {
  const { kind, frame } = parseHeader(data, 0);
  const [count, size, checksum] = headOf(data.subarray(START - HEAD, START));
  const body = data.subarray(START, START + size);
  const layered = kind === KIND.key && data[PACKET_HEADER] === 11 && viewOf(data).getUint32(17, true) === HEAD;
  if (!layered || body.length < size || count > mostGaussians(size) || crc32(body) !== checksum) return null;
  const found = splitSections(7, body, START);
  if (`${Object.keys(found)}` !== `meta,${ATTRIBUTES}`) return null;
  checkMemory(count, 14 + Math.min(45, found.shN.data[1] ?? 0), START + size);
  const scene = decodeAttributes(found, count);
  return firstState(frame, count, { scene, layout: null, meta: decodeMeta(found.meta.data), rest: found.shN.data[1] });
}

const looked = new WeakSet();

/** Say the first layer of the packet whose first bytes `walker` has, once, while `stream` has nothing else to say. */
export function look(stream, walker) {
  const head = walker.ahead(START);
  if (!head || stream.state || looked.has(walker)) return;
  const data = walker.ahead(START + headOf(head.subarray(START - 12))[1]);
  if (!data) return;
  looked.add(walker);
  const state = firstLayer(data);
  if (state?.frame === stream.target) stream.sendEarly(state);
}
