// The decoder as a module of WebAssembly, for hosts that have no other one. Nothing is imported but the .wasm file that
// `make -C plugins/c_decoder wasm` builds.
//
//     const decoder = await loadDecoder(await readFile("gss.wasm"));
//     const stream = decoder.open(bytes);               // a whole file, Uint8Array
//     while (stream.next()) draw(stream.frame);         // arrays of frame are views that hold until the next call
//     if (stream.error) console.error(stream.error.message);
//     stream.close();

const FRAME = 1;
const TEXT = new TextDecoder();

/** Compile a module: bytes of gss.wasm. */
export async function loadDecoder(wasm) {
  const { instance } = await WebAssembly.instantiate(wasm, {});
  instance.exports._initialize();
  return { open: (bytes, limit = 0) => new Stream(instance.exports, bytes, limit) };
}

/** A stream that is decoded frame by frame. `limit`: the most bytes to allocate, 0 for what there is. */
class Stream {
  constructor(gss, bytes, limit) {
    this.gss = gss;
    this.at = gss.malloc(bytes.length || 1);
    if (!this.at) throw new RangeError(`no memory for a stream of ${bytes.length} bytes`);
    new Uint8Array(gss.memory.buffer).set(bytes, this.at);
    this.stream = gss.gss_open(this.at, bytes.length, limit);
    if (!this.stream) throw new RangeError("no memory for a decoder");
  }

  /** Decode the next frame; false at the end of the stream, and where `error` says what ended it before. */
  next() {
    return this.gss.gss_next(this.stream) === FRAME;
  }

  /** The state after the last frame that was decoded (gss_frame of gss.h), or null. */
  get frame() {
    const at = this.gss.gss_state(this.stream);
    if (!at) return null;
    const { buffer } = this.gss.memory;
    const [frame, rows, nodes, harmonics, ...places] = new Uint32Array(buffer, at, 14);
    const floats = (i, width) => places[i] && new Float32Array(buffer, places[i], rows * width);
    return {
      frame,
      rows,
      harmonics,
      means: floats(0, 3),
      quats: floats(1, 4),
      scales: floats(2, 3),
      opacities: floats(3, 1),
      sh0: floats(4, 3),
      shN: floats(5, 3 * harmonics),
      nodeCounts: new Uint32Array(buffer, places[6], nodes),
      displaced: places[7] ? new Uint8Array(buffer, places[7], rows) : null,
      translations: floats(8, 3) || null,
      rotations: floats(9, 3) || null,
      background: new Float32Array(buffer, at + 56, 3),
    };
  }

  /** The meta of the last key packet: the object that docs/spec describes, of which texts come from strangers. */
  get meta() {
    const at = this.gss.gss_meta(this.stream);
    if (!at) return null;
    const [text, length] = new Uint32Array(this.gss.memory.buffer, at + 136, 2);
    return JSON.parse(TEXT.decode(new Uint8Array(this.gss.memory.buffer, text, length)));
  }

  /** What ended the stream before its end: the rule, the byte of the packet, a sentence; null where nothing did. */
  get error() {
    const at = this.gss.gss_error(this.stream);
    const view = new DataView(this.gss.memory.buffer, at, 184);
    if (!view.getInt32(0, true)) return null;
    return { rule: this.#text(at + 4), byte: Number(view.getBigUint64(16, true)), message: this.#text(at + 24) };
  }

  /** The hash of the last frame (section 0.5), 64 hexadecimal digits. */
  hash() {
    const digits = this.gss.malloc(65);
    this.gss.gss_hash(this.gss.gss_state(this.stream), digits);
    const text = this.#text(digits);
    this.gss.free(digits);
    return text;
  }

  /** Free everything; views of frames hold no longer. */
  close() {
    this.gss.gss_close(this.stream);
    this.gss.free(this.at);
  }

  #text(at) {
    const bytes = new Uint8Array(this.gss.memory.buffer, at);
    return TEXT.decode(bytes.subarray(0, bytes.indexOf(0)));
  }
}
