// A stream file by itself, with or without an index. The player of a package never loads this.

import { FILE_HEADER, parseHeader, parseIndex } from "./container.js";
import { SourceError, bytesOf, forbidden, joined, refusal, request } from "./download.js";

const TRAILER = 12;

/** What there is to play in the file at `url`, as `openSource` returns it. Throws SourceError. */
export async function openFile(url, signal) {
  const sequential = { first: null, last: null, url, start: 0, end: null, whole: true };
  const plain = { segments: [sequential], frames: null, fps: null, renditions: [] };
  const response = await request(url, { start: -TRAILER, signal }).catch(async (error) => {
    if (!signal?.aborted) await forbidden(url, error);
    throw error instanceof SourceError || signal?.aborted ? error : new SourceError(`There is no server at ${url}.`);
  });
  // A server that knows no ranges begins with all of it: it is asked again without one.
  if (response.status === 200) response.body.cancel().catch(() => {});
  if ([200, 416].includes(response.status)) return plain;
  if (response.status !== 206) throw refusal(response, url);
  const total = /\/(\d+)$/.exec(response.headers.get("Content-Range") ?? "");
  const tail = new Uint8Array(await response.arrayBuffer());
  if (!total || tail.length !== TRAILER || String.fromCharCode(...tail.subarray(8)) !== "GSSX") return plain;
  const offset = Number(new DataView(tail.buffer).getBigUint64(0, true));
  const segments = await indexed(url, offset, Number(total[1]), signal);
  if (!segments) return plain;
  const last = segments[segments.length - 1].last;
  return { segments, frames: last - segments[0].first + 1, fps: null, renditions: [] };
}

/** Segments by the index at the end of a file; null when it is none after all. */
async function indexed(url, offset, total, signal) {
  if (offset < FILE_HEADER || offset >= total) return null;
  const data = await joined(bytesOf(url, { start: offset, end: total - 1, signal }));
  try {
    const keys = parseIndex(data, offset);
    const last = parseHeader(data, offset).frame;
    if (!keys.length) return null;
    return keys.map((key, i) => ({
      first: key.frame,
      last: i + 1 < keys.length ? keys[i + 1].frame - 1 : last,
      url,
      start: i ? key.offset : 0,
      end: (i + 1 < keys.length ? keys[i + 1].offset : offset) - 1,
      whole: false,
    }));
  } catch {
    // Whatever it is, reading the file from its beginning says what is wrong and plays what is sound.
    return null;
  }
}
