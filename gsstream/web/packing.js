// What packets change in a scene, packed as the textures of the page hold it. All of it is done beside the page's thread.

import { GEOMETRY_TEXELS, colourTexels, shiftOf } from "./texels.js";

/** Slots that did not change but lie between two that did are sent too when they are at most so many. */
const GAP = 32;
/** Values of one part, which the page uploads at once: a mebibyte. */
const PART = 1 << 18;

const GEOMETRY = new Set(["means", "quats", "scales", "opacities"]);

/** Slots of one texture, or of the list of positions, that changed since they were sent. */
class Marks {
  constructor(texels) {
    Object.assign(this, { texels, shift: shiftOf(texels), capacity: 0, list: [], all: false });
    this.dirty = new Uint8Array(0);
  }

  /** Make room for `used` slots; what grows is sent anew. */
  fit(used) {
    if (used <= this.capacity) return;
    this.capacity = Math.ceil((Math.ceil(used * 1.25) + 1) / 2 ** this.shift) * 2 ** this.shift;
    this.dirty = new Uint8Array(this.capacity);
    this.list = [];
    this.all = true;
  }

  mark(slot) {
    if (this.dirty[slot]) return;
    this.dirty[slot] = 1;
    this.list.push(slot);
  }

  /** The marked slots, ascending; nothing is marked any more. */
  take() {
    const slots = Uint32Array.from(this.list).sort();
    for (const slot of slots) this.dirty[slot] = 0;
    this.list = [];
    this.all = false;
    return slots;
  }

  /**
   * What is to be uploaded: `{ capacity, all, parts }`, each part `{ runs, data }`: pairs of first slot and the one
   * behind the last, and their texels one run after the other, as `fill(out, at, start, stop)` writes them.
   */
  packed(used, fill) {
    const { capacity, texels, all } = this;
    const many = all || this.list.length > used / 2;
    const slots = this.take();
    const runs = many ? this._lines(used) : this._runs(slots);
    const parts = [];
    for (let i = 0; i < runs.length;) {
      const first = i;
      let size = 0;
      do {
        size += 4 * texels * (runs[i + 1] - runs[i]);
        i += 2;
      } while (i < runs.length && size + 4 * texels * (runs[i + 1] - runs[i]) <= PART);
      const part = { runs: runs.slice(first, i), data: new Float32Array(size) };
      for (let k = 0, at = 0; k < part.runs.length; k += 2) {
        const [start, stop] = [part.runs[k], part.runs[k + 1]];
        fill(part.data, at, start, stop);
        at += 4 * texels * (stop - start);
      }
      parts.push(part);
    }
    return { capacity, all, parts };
  }

  /** Everything, in whole lines. */
  _lines(used) {
    const line = 2 ** this.shift;
    const step = line * Math.max(1, Math.floor(PART / (4 * this.texels * line)));
    const stop = Math.ceil(used / line) * line;
    const runs = [];
    for (let start = 0; start < stop; start += step) runs.push(start, Math.min(start + step, stop));
    return Uint32Array.from(runs);
  }

  _runs(slots) {
    const runs = [];
    for (const slot of slots) {
      const last = runs.length - 1;
      const near = last > 0 && slot - runs[last] < GAP && slot >> this.shift === runs[last - 1] >> this.shift;
      if (near) runs[last] = slot + 1;
      else runs.push(slot, slot + 1);
    }
    return Uint32Array.from(runs);
  }
}

/** The scene as the page has it: in which slot each row lies, and what is to be sent of it. */
export class Packer {
  constructor() {
    this.slots = new Slots();
    this.stamps = new Float32Array(0);
    this.geometry = new Marks(GEOMETRY_TEXELS);
    this.places = new Marks(GEOMETRY_TEXELS);
    this.colours = null;
    this.degree = -1;
    this.anew = this.renamed = false;
  }

  /** Take note of what the packet just decoded into `state` changed. Call it once for every packet. */
  update(state) {
    const { change } = state;
    if (change.kind === "key") {
      this.slots.reset(state.number);
      this.stamps = new Float32Array(0);
      this._fit(state);
      this.whole();
      this.renamed = true;
    } else if (change.kind === "delta") {
      this._mark(change, state.frame);
      if (change.source) this._follow(change, state);
    }
  }

  /** Send everything with the next pack: the graphics of the page forgot it. */
  whole() {
    this.geometry.all = this.colours.all = this.anew = true;
  }

  /**
   * What changed since the last pack: `{ used, degree, textures: { geometry, colours }, places, list }`. `places` is
   * `{ anew, slots, positions }`: where the Gaussians of `slots`, or of all slots if `anew`, are, NaN where none is.
   * `list` is the slot of each row, null while they are the same, left out where nothing changed in that.
   * `transfer` lists the buffers of all of it.
   */
  pack(state) {
    const { used } = this.slots;
    const fills = { geometry: this._fillGeometry, colours: this._fillColours };
    const textures = {};
    for (const [name, fill] of Object.entries(fills)) {
      textures[name] = this[name].packed(used, (...run) => fill.call(this, state, ...run));
    }
    const update = { used, degree: this.degree, textures, places: this._places(state) };
    if (this.renamed) update.list = this.slots.plain ? null : this.slots.slotOf.slice();
    this.anew = this.renamed = false;
    const arrays = Object.values(textures).flatMap(({ parts }) => parts.flatMap(({ runs, data }) => [runs, data]));
    arrays.push(update.places.slots, update.places.positions, update.list);
    return { update, transfer: arrays.filter(Boolean).map(({ buffer }) => buffer) };
  }

  _places(state) {
    const { means } = state.scene;
    const { rowOf } = this.slots;
    const { anew } = this;
    const marked = this.places.take();
    const slots = anew ? null : marked;
    const positions = new Float32Array(3 * (anew ? this.geometry.capacity : slots.length)).fill(NaN);
    for (let i = 0; i < positions.length / 3; i += 1) {
      const row = rowOf[anew ? i : slots[i]];
      if (row >= 0) for (let k = 0; k < 3; k += 1) positions[3 * i + k] = means[3 * row + k];
    }
    return { anew, slots, positions };
  }

  _fit({ widths }) {
    const degree = Math.round(Math.sqrt(widths.shN / 3 + 1)) - 1;
    if (degree !== this.degree) this.colours = new Marks(colourTexels(degree));
    this.degree = degree;
    const { capacity } = this.geometry;
    for (const marks of [this.geometry, this.colours, this.places]) marks.fit(this.slots.used);
    if (this.geometry.capacity !== capacity) this.anew = true;
    const stamps = new Float32Array(this.geometry.capacity).fill(-1);
    stamps.set(this.stamps);
    this.stamps = stamps;
  }

  _mark(change, frame) {
    const { slotOf } = this.slots;
    for (const { rows, attributes } of change.moved) {
      const moves = attributes.includes("means");
      const shines = attributes.some((name) => !GEOMETRY.has(name));
      for (const row of rows) {
        const slot = slotOf[row];
        this.stamps[slot] = frame;
        this.geometry.mark(slot);
        if (shines) this.colours.mark(slot);
        if (moves) this.places.mark(slot);
      }
    }
  }

  _follow(change, state) {
    const { added, removed } = this.slots.follow(change.source, change.before);
    this._fit(state);
    for (const slot of added) {
      this.stamps[slot] = state.frame;
      this.colours.mark(slot);
    }
    for (const slot of removed) this.stamps[slot] = -1;
    for (const slot of [...added, ...removed]) {
      this.geometry.mark(slot);
      this.places.mark(slot);
    }
    this.renamed = true;
  }

  _fillGeometry({ scene: { means, quats, scales, opacities } }, out, from, start, stop) {
    const { rowOf } = this.slots;
    for (let slot = start, at = from; slot < stop; slot += 1, at += 4 * GEOMETRY_TEXELS) {
      const row = rowOf[slot];
      if (!(row >= 0)) {
        // A dead slot: a logit that no opacity cut lets through.
        out[at + 3] = -1e9;
        continue;
      }
      for (let i = 0; i < 3; i += 1) {
        out[at + i] = means[3 * row + i];
        out[at + 8 + i] = scales[3 * row + i];
      }
      out[at + 3] = opacities[row];
      for (let i = 0; i < 4; i += 1) out[at + 4 + i] = quats[4 * row + i];
      out[at + 11] = this.stamps[slot];
    }
  }

  _fillColours({ scene: { sh0, shN }, widths: { shN: width } }, out, from, start, stop) {
    const { rowOf } = this.slots;
    const step = 4 * this.colours.texels;
    for (let slot = start, at = from; slot < stop; slot += 1, at += step) {
      const row = rowOf[slot];
      if (!(row >= 0)) continue;
      for (let i = 0; i < 3; i += 1) out[at + i] = sh0[3 * row + i];
      for (let i = 0; i < width; i += 1) out[at + 3 + i] = shN[width * row + i];
    }
  }
}

/** A row keeps its slot until it is removed; added rows take the slots of removed ones. */
class Slots {
  constructor() {
    this.reset(0);
  }

  /** Rows 0 to `number` - 1 in slots of the same number. */
  reset(number) {
    this.slotOf = Uint32Array.from({ length: number }, (_, row) => row);
    this.rowOf = Int32Array.from(this.slotOf);
    this.used = number;
    this.free = [];
    /** Whether every row lies in the slot of its own number. */
    this.plain = true;
  }

  /**
   * Follow added and removed rows: `source` says which of `before` rows each row was; beyond are added rows.
   *
   * Returns `{ added, removed }`, lists of slots.
   */
  follow(source, before) {
    this.plain = false;
    const slotOf = new Uint32Array(source.length);
    const stays = new Uint8Array(before);
    const addedRows = [];
    source.forEach((row, i) => {
      if (row < before) {
        slotOf[i] = this.slotOf[row];
        stays[row] = 1;
      } else {
        addedRows.push(i);
      }
    });
    const removed = [];
    for (let row = 0; row < before; row += 1) if (!stays[row]) removed.push(this.slotOf[row]);
    this.free.push(...removed);
    const added = addedRows.map((i) => {
      slotOf[i] = this.free.length ? this.free.pop() : this.used++;
      return slotOf[i];
    });
    const reused = new Set(added);
    this.slotOf = slotOf;
    this.rowOf = new Int32Array(this.used).fill(-1);
    slotOf.forEach((slot, row) => {
      this.rowOf[slot] = row;
    });
    return { added, removed: removed.filter((slot) => !reused.has(slot)) };
  }
}
