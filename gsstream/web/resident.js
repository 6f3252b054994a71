// A scene in the memory of the graphics, kept up to date packet by packet: what a packet changed is sent, nothing else.

import { SceneTextures } from "./scene-textures.js";

const GEOMETRY = new Set(["means", "quats", "scales", "opacities"]);

/** Textures of a scene, and the slot in which each of its rows lies. */
export class ResidentScene {
  constructor(gl) {
    this.gl = gl;
    this.slots = new Slots();
    this.textures = new SceneTextures(gl, this.slots);
  }

  /** Slots there is room for. */
  get capacity() {
    return this.textures.geometry.capacity;
  }

  /**
   * Take note of what the packet just decoded into `state` changed. Call it once for every packet.
   *
   * Returns `{ anew, moved }`: whether all slots were given out anew, and those whose position is another than before.
   */
  update(state) {
    const { change } = state;
    if (change.kind === "key") {
      this.slots.reset(state.number);
      this.textures.stamps = new Float32Array(0);
      this.textures.fit(state, true);
      return { anew: true, moved: this.slots.slotOf };
    }
    if (change.kind !== "delta") return { anew: false, moved: [] };
    const moved = this._mark(change, state.frame);
    return change.source ? this._follow(change, state, moved) : { anew: false, moved };
  }

  /** The graphics forgot everything: make the textures again, for the state they held. */
  restore(state) {
    this.textures = new SceneTextures(this.gl, this.slots);
    if (state) this.textures.fit(state, true);
  }

  _mark(change, frame) {
    const { slotOf } = this.slots;
    const { geometry, colours, stamps } = this.textures;
    const moved = [];
    for (const { rows, attributes } of change.moved) {
      const moves = attributes.includes("means");
      const shines = attributes.some((name) => !GEOMETRY.has(name));
      for (const row of rows) {
        const slot = slotOf[row];
        stamps[slot] = frame;
        geometry.mark(slot);
        if (shines) colours.mark(slot);
        if (moves) moved.push(slot);
      }
    }
    return moved;
  }

  _follow(change, state, moved) {
    const { added, removed } = this.slots.follow(change.source, change.before);
    const before = this.capacity;
    this.textures.fit(state, false);
    const { geometry, colours, stamps } = this.textures;
    for (const slot of added) {
      stamps[slot] = state.frame;
      geometry.mark(slot);
      colours.mark(slot);
    }
    for (const slot of removed) {
      stamps[slot] = -1;
      geometry.mark(slot);
    }
    const anew = this.capacity !== before;
    return { anew, moved: anew ? this.slots.slotOf : [...moved, ...added, ...removed] };
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
  }

  /**
   * Follow added and removed rows: `source` says which of `before` rows each row was; beyond are added rows.
   *
   * Returns `{ added, removed }`, lists of slots.
   */
  follow(source, before) {
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
