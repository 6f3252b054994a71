// What there is to play at an address: a manifest with segments, or a stream file with or without an index.

import { sectionsOf } from "./container.js";
import { SourceError, bytesOf, fileOf } from "./download.js";
import { FORMAT_MAJOR, FORMAT_MINOR } from "./limits.js";
import { PacketWalker } from "./walker.js";

/**
 * Find out what is at `url`: `{ segments, frames, fps, renditions }`.
 *
 * A segment is `{ first, last, url, start, end, whole }`: a key packet and what follows, bytes `start` to `end` of a
 * file, or the whole file. `last` and `frames` are null where only playing tells. Where a segment can be joined in its
 * middle, each piece is an entry: those behind the first have `join`, the state they begin with, and `key`,
 * the key packet that it refers to; `all` says where their file ends. A live stream has only `follow(stream)`, which
 * returns its buffer. Throws SourceError or PacketError.
 */
export async function openSource(url, signal) {
  const address = new URL(url);
  if (/^wss?:$/.test(address.protocol)) return liveSource(address);
  if (address.pathname.endsWith("/")) address.pathname += "stream.json";
  if (address.pathname.endsWith(".json")) return openManifest(address.href, signal);
  // Only who plays a file by itself needs this module.
  return (await import("./file.js")).openFile(address.href, signal);
}

async function openManifest(url, signal) {
  const data = await fileOf(url, { signal });
  let manifest;
  try {
    manifest = JSON.parse(new TextDecoder().decode(data));
  } catch {
    throw new SourceError(`${url} is no manifest of a stream. Name a stream.json or a .gss file.`);
  }
  const version = /^gsstream (\d+)\.(\d+)$/.exec(manifest?.format ?? "");
  if (version && (Number(version[1]) !== FORMAT_MAJOR || Number(version[2]) > FORMAT_MINOR)) {
    throw new SourceError(
      `This stream has packet format ${version[1]}.${version[2]}; this player reads ${FORMAT_MAJOR}.${FORMAT_MINOR}.`,
    );
  }
  if (typeof manifest?.live === "string") return liveSource(beside(manifest.live, url));
  if (manifest?.parts) return liveSource(new URL(url), true);
  const renditions = [manifest, ...(manifest.renditions ?? [])].map((entry, i) => ({
    name: entry.name ?? (i ? `rendition ${i}` : "full"),
    gaussians: entry.gaussians ?? null,
    segments: segmentsOf(entry, url),
  }));
  const { segments } = renditions[0];
  const last = segments[segments.length - 1].last;
  const poster = manifest.poster && beside(manifest.poster, url).href;
  return { segments, frames: last - segments[0].first + 1, fps: manifest.fps ?? null, renditions, poster };
}

/** A stream as it is written, from its socket or in parts. */
async function liveSource(address, parts) {
  const { LiveBuffer } = await import("./live.js");
  const follow = (stream) => new LiveBuffer(address.href, stream, parts);
  return { live: true, follow, segments: [], frames: null, fps: null, renditions: [] };
}

/** What a manifest names, with the token of its own address, if it has one. */
function beside(name, base) {
  const address = new URL(name, base);
  const { origin, searchParams } = new URL(base);
  if (origin === address.origin && searchParams.has("token")) {
    address.searchParams.set("token", searchParams.get("token"));
  }
  return address;
}

function segmentsOf(entry, base) {
  const list = entry?.segments;
  const sound = Array.isArray(list) && list.length && list.every((s) => Array.isArray(s.frames) && (s.file || s.range));
  if (!sound) throw new SourceError(`${base} is no manifest of a stream: it lists no segments.`);
  return list.flatMap((segment) => piecesOf(segment, entry, base));
}

function piecesOf(segment, entry, base) {
  const whole = {
    first: segment.frames[0],
    last: segment.frames[1],
    url: beside(segment.file ?? entry.file, base).href,
    start: segment.file ? 0 : segment.range[0],
    end: segment.file ? (segment.bytes ?? null) && segment.bytes - 1 : segment.range[1],
    whole: Boolean(segment.file),
  };
  const joins = segment.joins ?? [];
  if (!joins.length) return [whole];
  const key = { url: whole.url, start: 0, end: segment.key_bytes - 1, first: whole.first };
  return [null, ...joins].map((join, i) => ({
    first: join ? join.frame : whole.first,
    last: i < joins.length ? joins[i].frame - 1 : whole.last,
    url: whole.url,
    start: join ? join.offset : 0,
    end: i < joins.length ? joins[i].offset - 1 : whole.end,
    whole: false,
    all: { end: whole.end },
    key: join && key,
    join: join && { url: new URL(join.file, base).href, bytes: join.bytes ?? null },
  }));
}

/**
 * Packets `{ data, offset, header }` of a segment as they arrive. `onPart` gets the walker while it holds a part of
 * a packet with layers. Throws PacketError or SourceError.
 */
export async function* packetsOf(segment, signal, onPart) {
  const all = segment.all && { ...segment.all, sent: false };
  const chunks = bytesOf(segment.url, { ...segment, all, signal });
  // Whether the server sends the piece or the whole file is known with the first bytes.
  const make = () => (all?.sent ? new PacketWalker(0) : new PacketWalker(segment.start, segment.join && segment.first));
  let walker = null;
  for await (const chunk of chunks) {
    walker ??= make();
    walker.push(chunk);
    for (let packet = walker.next(); packet; packet = walker.next()) {
      for (const section of sectionsOf(packet.data)) {
        if (section === 10) await import("./changes/field.js");
        if (section === 13) await import("./changes/light.js");
      }
      yield packet;
    }
    // Section 11, which begins a packet, are layers.
    if (walker.ahead(17)?.[16] === 11) onPart?.(walker);
  }
  (walker ?? make()).finish();
}
