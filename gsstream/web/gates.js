// Gates: alternating runs of closed and open entries, with a level for each open one.

import { BitReader, unpackParts } from "./bits.js";
import { PacketError } from "./errors.js";
import { decodeSymbols, range } from "./symbols.js";

const DIRECT = 16;
const DIRECT_BITS = 4;

/** Decode gates of `number` entries: `{ gates: Uint8Array, levels }`; 0 is closed, `levels` is fully open. */
export function decodeGates(data, number) {
  const [headBytes, even, odd, levelBytes] = unpackParts(data, 4);
  const head = new BitReader(headBytes);
  const levels = head.gamma() + 1;
  const count = head.gamma();
  const first = head.bits(1);
  if (levels > 255 || count > number || (count === 0) !== (number === 0)) {
    throw new PacketError(`gates: ${levels} levels in ${count} runs over ${number} nodes cannot be`);
  }
  const runs = new Float64Array(count);
  [even, odd].forEach((part, parity) => {
    const sent = Math.max(0, Math.ceil((count - 1 - parity) / 2));
    const tokens = decodeSymbols(part, sent, 1);
    checkTokens(tokens);
    for (let i = 0; i < sent; i += 1) runs[2 * i + parity] = runLength(tokens[i], head) + 1;
  });
  head.finish();
  const gates = new Uint8Array(number);
  const open = fillRuns(gates, runs, first);
  const values = decodeSymbols(levelBytes, levels > 1 ? open : 0, 1);
  if (values.length) {
    const [low, high] = range(values);
    if (low < 1 || high > levels) throw new PacketError(`gate level outside 1 to ${levels}`);
    for (let i = 0, k = 0; i < number; i += 1) if (gates[i]) gates[i] = values[k++];
  }
  return { gates, levels };
}

/** Write ones where runs are open; the last run is what is left. Returns how many entries are open. */
function fillRuns(gates, runs, first) {
  if (runs.length === 0) return 0;
  let sum = 0;
  for (let i = 0; i < runs.length - 1; i += 1) sum += runs[i];
  runs[runs.length - 1] = gates.length - sum;
  if (runs[runs.length - 1] < 1) {
    throw new PacketError(`gate runs cover more than the ${gates.length} nodes of the scene`);
  }
  let at = 0;
  let open = 0;
  for (let i = 0; i < runs.length; i += 1) {
    if ((i + first) % 2) {
      gates.fill(1, at, at + runs[i]);
      open += runs[i];
    }
    at += runs[i];
  }
  return open;
}

function checkTokens(tokens) {
  if (!tokens.length) return;
  const [low, high] = range(tokens);
  if (low < 0 || high >= DIRECT + 2 * 28) throw new PacketError("run-length token out of range");
}

function runLength(token, head) {
  if (token < DIRECT) return token;
  const length = ((token - DIRECT) >> 1) + DIRECT_BITS;
  const second = (token - DIRECT) & 1;
  return 2 ** length + second * 2 ** (length - 1) + head.bits(length - 1);
}
