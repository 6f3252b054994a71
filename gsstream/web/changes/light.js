// The light of a delta packet: one factor a channel on the colours of the whole scene.

import { PacketError } from "../errors.js";
import { later } from "../key.js";
import { half } from "./residual.js";

const [LEAST, MOST] = [1 / 16, 16];
/** Half, which a colour has where sh0 is 0, over the harmonic of degree 0. */
const OFFSET = 1.7724538509055159;

later.light = decodeLight;

/** What the data of the section make of a state, which stays as it is: `{ sh0, shN, background }`. */
function decodeLight(data, { scene: { sh0, shN }, background }) {
  if (data.length !== 6) throw new PacketError(`light: expected 6 bytes, got ${data.length}`);
  const factor = [0, 2, 4].map((at) => half(data[at] | (data[at + 1] << 8)));
  if (!factor.every((value) => value >= LEAST && value <= MOST)) {
    throw new PacketError(`light: factor: expected three numbers from ${LEAST} to ${MOST}, got ${factor}`);
  }
  const offset = factor.map((value) => Math.fround((value - 1) * OFFSET));
  const lit = {
    sh0: sh0.map((value, i) => Math.fround(value * factor[i % 3]) + offset[i % 3]),
    shN: shN.map((value, i) => value * factor[i % 3]),
    background: Float32Array.from(background, (value, i) => Math.fround(value) * factor[i]),
  };
  if (!Object.values(lit).every((values) => values.every(Number.isFinite))) {
    throw new PacketError("light: it leads colours out of the range of float32");
  }
  return lit;
}
