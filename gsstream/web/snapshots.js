// Decoded key packets, kept so that a loop or a short way back does not decode them again.

const MOST = 2;

/** A copy of a state that later packets do not touch. */
function copied(state) {
  const scene = Object.fromEntries(Object.entries(state.scene).map(([name, values]) => [name, values.slice()]));
  return { ...state, scene, decoders: new Map(state.decoders) };
}

/** The first key packet and the one used last. */
export class Snapshots {
  constructor() {
    this.kept = [];
  }

  clear() {
    this.kept = [];
  }

  /** A fresh copy of the state after a key packet, or null. */
  get(packet) {
    const found = this.kept.find((entry) => entry.packet === packet);
    return found ? copied(found.state) : null;
  }

  keep(packet, state) {
    if (this.kept.length === MOST) this.kept.pop();
    this.kept.push({ packet, state: copied(state) });
  }
}
