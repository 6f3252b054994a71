// The first picture while the rest of its packet is on its way. Only who waits for a packet with layers loads this.

import { START, firstLayer, headOf } from "./layers.js";

const looked = new WeakSet();

/** Say the first layer of the packet whose first bytes `walker` has, once, while `stream` has nothing else to say. */
export function look(stream, walker) {
  const head = walker.ahead(START);
  if (!head || stream.state || looked.has(walker)) return;
  const data = walker.ahead(START + headOf(head.subarray(START - 12))[1]);
  if (!data) return;
  looked.add(walker);
  const state = firstLayer(data);
  if (state?.frame === stream.target) stream.sendEarly(state);
}
