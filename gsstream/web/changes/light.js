// The light of a delta packet: one factor a channel on the colours of the whole scene.

import { PacketError } from "../errors.js";
import { later } from "../key.js";
import { half } from "./residual.js";

const [LEAST, MOST] = [1 / 256, 256];
/** Half, which a colour has where sh0 is 0, over the harmonic of degree 0. */
const OFFSET = 1.7724538509055159;

later.light = decodeLight;

/**
 * What the data of the section make of a state, which stays as it is: `state`, one in which the rest of the packet is
 * decoded (motions form groups by brightness), and `apply`, which changes that of before and notes what changed.
 */
function decodeLight(data, before) {
  if (data.length !== 6) throw new PacketError(`light: expected 6 bytes, got ${data.length}`);
  const factor = [0, 2, 4].map((at) => half(data[at] | (data[at + 1] << 8)));
  if (!factor.every((value) => value >= LEAST && value <= MOST)) {
    throw new PacketError(`light: factor: expected three numbers from ${LEAST} to ${MOST}, got ${factor}`);
  }
  const { scene, meta, background = meta.background } = before;
  const offset = factor.map((value) => Math.fround((value - 1) * OFFSET));
  const colours = {
    sh0: scene.sh0.map((value, i) => Math.fround(value * factor[i % 3]) + offset[i % 3]),
    shN: scene.shN.map((value, i) => value * factor[i % 3]),
  };
  const behind = Float32Array.from(background, (value, i) => Math.fround(value) * factor[i]);
  if (![...Object.values(colours), behind].every((values) => values.every(Number.isFinite))) {
    throw new PacketError("light: it leads colours out of the range of float32");
  }
  const apply = (state, change) => {
    Object.assign(state.scene, colours);
    Object.assign(state, { background: behind, turned: true });
    const rows = Uint32Array.from({ length: state.number }, (_, row) => row);
    change.moved.push({ rows, gate: null, attributes: ["sh0", "shN"] });
  };
  // The memory that the state of before keeps for motions is not for this one.
  return { state: { ...before, scene: { ...scene, ...colours }, spare: null }, apply };
}
