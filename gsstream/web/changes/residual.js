// The residual of a delta packet: the Gaussians behind open gates change by decoded symbols.

import { PacketError, ofSection } from "../errors.js";
import { ATTRIBUTES, MAX_CHANNELS, WIDTHS } from "../limits.js";
import { decodeGates, decodeSymbols, largest, within } from "../symbols.js";

const LATENT = 1;
const MAX_CHANGE = 1e18;

/** Sections that this change is made of. */
export const SECTIONS = ["gates", "pattern", "decoders", ...ATTRIBUTES];

/**
 * Decode the residual from sections by name. Nothing of `state` changes.
 *
 * Returns `{ rows: Uint32Array [A], gate: Float32Array [A], levels, parts, decoders }`: the rows that change with their
 * gates, for each attribute its symbols, step and decoder, and the decoders that hold from now on. Symbols are those of
 * the rows at `places` of `rows`, or of all of them where that is null.
 */
export function decodeResidual(sections, state, offset) {
  const { counts } = state.layout;
  const { gates, levels } = ofSection(sections.gates, (data) => decodeGates(data, counts.length));
  const { rows, gate } = openRows(counts, gates, levels);
  const decoders = new Map(state.decoders);
  const sent = ofSection(sections.decoders, decodeDecoders) ?? new Map();
  for (const [name, decoder] of sent) decoders.set(name, decoder);
  const names = ATTRIBUTES.filter((name) => sections[name]);
  const pattern = ofSection(sections.pattern, (data) => decodePattern(data, rows.length, names.length));
  const parts = names.map((name, bit) =>
    ofSection(sections[name], (data) => {
      const places = pattern && placesOf(pattern, bit);
      const number = places ? places.length : rows.length;
      return { ...decodePart(name, data, number, decoders), places };
    }),
  );
  for (const name of sent.keys()) {
    if (!parts.some((part) => part.name === name && part.decoder)) {
      throw new PacketError("delta packet: a decoder is sent that no attribute uses", sections.decoders.offset);
    }
  }
  for (const { name, width } of rows.length ? parts : []) {
    if (width === state.widths[name]) continue;
    const words = `delta of ${name}: expected ${state.widths[name]} values a row, got ${width}`;
    throw new PacketError(`${words}; the packet belongs to another scene`, offset);
  }
  return { rows, gate, levels, parts, decoders };
}

/** Change the rows of `state` in place, in float32 and in the order of operations of the format. */
export function applyResidual(state, residual) {
  const { rows, gate, parts } = residual;
  state.decoders = residual.decoders;
  if (rows.length === 0) return;
  const { unitOf, units } = state.layout;
  const scale = new Float32Array(rows.length);
  for (let i = 0; i < rows.length; i += 1) scale[i] = gate[i] * units[unitOf[rows[i]]];
  for (const part of parts) {
    // A symbol of 0 adds 0 or -0, which changes nothing but a value of -0. Of these there are none except where a
    // motion or a light was: key packets and added Gaussians hold multiples of a step, and no sum of two others is -0.
    const values = state.scene[part.name];
    const zeros = state.turned && holdMinusZero(values, rows, part.width);
    const sent = zeros && part.places ? { ...part, symbols: spread(part, rows.length), places: null } : part;
    const add = part.decoder ? addDecoded : addDirect;
    add(values, rows, part.name === "means" ? scale : gate, sent, zeros);
  }
}

/** Whether a value of `rows` is -0, which is rare. */
function holdMinusZero(values, rows, width) {
  for (let i = 0; i < rows.length; i += 1) {
    for (let at = rows[i] * width; at < (rows[i] + 1) * width; at += 1) if (Object.is(values[at], -0)) return true;
  }
  return false;
}

/** Add step * symbols * gate. With `zeros` also where the symbol is 0, which rids a value of -0 of its sign. */
function addDirect(values, rows, gate, { symbols, places, step, width }, zeros) {
  const number = symbols.length / width;
  for (let d = 0, from = 0; d < width; d += 1, from += number) {
    for (let j = 0; j < number; j += 1) {
      const symbol = symbols[from + j];
      if (symbol === 0 && !zeros) continue;
      const i = places === null ? j : places[j];
      const at = rows[i] * width + d;
      if (symbol === 0 && values[at] !== 0) continue;
      const latent = Math.fround(Math.fround(symbol) * step);
      values[at] += Math.fround(latent * gate[i]);
    }
  }
}

/** Add the decoder's product of step * symbols, times gate; `zeros` as in `addDirect`. */
function addDecoded(values, rows, gate, { symbols, places, channels, step, width, decoder }, zeros) {
  const weights = decoder.values;
  const number = symbols.length / channels;
  const change = new Float32Array(width);
  for (let j = 0; j < number; j += 1) {
    let some = 0;
    for (let at = j; at < symbols.length; at += number) some |= symbols[at];
    if (some === 0 && !zeros) continue;
    // A symbol of 0 adds nothing but, perhaps, a sign.
    let first = true;
    for (let c = 0, at = j; c < channels; c += 1, at += number) {
      if (symbols[at] === 0 && !zeros) continue;
      const latent = Math.fround(Math.fround(symbols[at]) * step);
      const from = c * width;
      if (first) for (let d = 0; d < width; d += 1) change[d] = latent * weights[from + d];
      else for (let d = 0; d < width; d += 1) change[d] += Math.fround(latent * weights[from + d]);
      first = false;
    }
    const i = places === null ? j : places[j];
    const start = rows[i] * width;
    for (let d = 0; d < width; d += 1) {
      if (some !== 0 || values[start + d] === 0) values[start + d] += Math.fround(change[d] * gate[i]);
    }
  }
}

function openRows(counts, gates, levels) {
  let number = 0;
  for (let node = 0; node < gates.length; node += 1) if (gates[node]) number += counts[node];
  const rows = new Uint32Array(number);
  const gate = new Float32Array(number);
  for (let node = 0, row = 0, at = 0; node < gates.length; node += 1) {
    const end = row + counts[node];
    if (gates[node]) {
      const value = gates[node] / levels;
      for (; row < end; row += 1, at += 1) {
        rows[at] = row;
        gate[at] = value;
      }
    }
    row = end;
  }
  return { rows, gate };
}

/** For each row behind an open gate, a number: bit i is set where the i-th attribute sent has symbols for it. */
function decodePattern(data, rows, attributes) {
  if (attributes === 0) throw new PacketError("pattern of rows without an attribute that changes");
  const most = (1 << attributes) - 1;
  return within(decodeSymbols(data, rows, 1), 0, most, `pattern of a row: expected 0 to ${most} for ${attributes} attributes`);
}

/** The places of a pattern that have a bit, ascending. */
function placesOf(pattern, bit) {
  let number = 0;
  for (let i = 0; i < pattern.length; i += 1) number += (pattern[i] >> bit) & 1;
  const places = new Uint32Array(number);
  for (let i = 0, at = 0; i < pattern.length; i += 1) if ((pattern[i] >> bit) & 1) places[at++] = i;
  return places;
}

/** The symbols of all rows, zeros where there are none. Channel after channel. */
function spread({ symbols, channels, places }, rows) {
  const out = new Int32Array(rows * channels);
  for (let c = 0, from = 0; c < channels; c += 1) {
    for (let j = 0; j < places.length; j += 1) out[c * rows + places[j]] = symbols[from++];
  }
  return out;
}

function decodeDecoders(data) {
  const out = new Map();
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  let at = 0;
  while (at < data.length) {
    if (at + 3 > data.length) throw new PacketError("decoder header cut short");
    const [index, latents, width] = data.subarray(at, at + 3);
    at += 3;
    const name = ATTRIBUTES[index];
    if (!name || out.has(name) || latents < 1 || latents > MAX_CHANNELS) {
      throw new PacketError(`decoder of attribute ${index} with ${latents} latents is repeated or cannot be`);
    }
    if (!WIDTHS[name].includes(width) || width === 0 || 2 * latents * width > data.length - at) {
      throw new PacketError(`decoder of ${name}: ${latents} x ${width} does not fit the section`);
    }
    const values = new Float32Array(latents * width);
    for (let i = 0; i < values.length; i += 1) values[i] = half(view.getUint16(at + 2 * i, true));
    if (!values.every(Number.isFinite)) throw new PacketError(`decoder of ${name}: a value is not finite`);
    out.set(name, { values, latents, width });
    at += 2 * latents * width;
  }
  return out;
}

/** A float16 from its bits. */
export function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1024 + fraction) * 2 ** (exponent - 25);
}

function decodePart(name, data, rows, known) {
  if (data.length < 6) throw new PacketError(`${name} cut short`);
  const [mode, channels] = data;
  const step = new DataView(data.buffer, data.byteOffset).getFloat32(2, true);
  const decoder = mode === LATENT ? known.get(name) : null;
  if (mode > LATENT || decoder === undefined) {
    throw new PacketError(`${name}: mode ${mode} is unknown, or its decoder was never sent`);
  }
  if (!(step > 0 && step < 1e6)) throw new PacketError(`step of ${name}: expected above 0 and below 1e6, got ${step}`);
  const fits = decoder ? channels === decoder.latents : WIDTHS[name].includes(channels);
  if (!fits || channels === 0) throw new PacketError(`symbols of ${name}: ${channels} channels do not fit`);
  const symbols = decodeSymbols(data.subarray(6), rows, channels);
  const change = largest(symbols) * step * (decoder ? channels * largest(decoder.values) : 1);
  if (change > MAX_CHANGE) throw new PacketError(`${name}: a residual of ${change} cannot be`);
  return { name, symbols, channels, step, decoder, width: decoder ? decoder.width : channels };
}
