// A scene in the memory of the graphics, kept up to date packet by packet: what a packet changed is sent, nothing else.

import { SceneTextures } from "./scene-textures.js";
import { Slots } from "./slots.js";

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
    const { born, dead } = this.slots.follow(change.source, change.before);
    const before = this.capacity;
    this.textures.fit(state, false);
    const { geometry, colours, stamps } = this.textures;
    for (const slot of born) {
      stamps[slot] = state.frame;
      geometry.mark(slot);
      colours.mark(slot);
    }
    for (const slot of dead) {
      stamps[slot] = -1;
      geometry.mark(slot);
    }
    const anew = this.capacity !== before;
    return { anew, moved: anew ? this.slots.slotOf : [...moved, ...born, ...dead] };
  }
}
