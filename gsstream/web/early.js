// The first picture while the rest of its packet is on its way. Only who waits for a packet with layers loads this.

import { cameraOf, viewsOf } from "./camera.js";
import { START, firstLayer, headOf } from "./layers.js";

const looked = new WeakSet();

/** Show the first layer of the packet whose first bytes `walker` has, once, while `player` has nothing else to show. */
export function look(player, walker) {
  const head = walker.ahead(START);
  if (!head || player.state || looked.has(walker)) return;
  const data = walker.ahead(START + headOf(head.subarray(START - 12))[1]);
  if (!data) return;
  looked.add(walker);
  const state = firstLayer(data);
  if (state?.frame === player._target) show(player, state);
}

/** Draw `state` from where the player will look first, again whenever the canvas or the order changes. */
function show(player, state) {
  const { buffer, canvas, options, renderer } = player;
  const views = viewsOf(state.meta);
  const view = views.find(({ id }) => id === options.camera) ?? views[0];
  if (!view) return;
  renderer.update(state);
  player.invalidate();
  const turn = () => {
    // Once there is a state the player draws; a renderer of another stream is not touched any more.
    if (player.state || player.buffer !== buffer || player._closed) return;
    requestAnimationFrame(turn);
    if (!player._dirty) return;
    player._dirty = false;
    const drew = renderer.draw(cameraOf(view, canvas.width, canvas.height));
    if (drew !== false) player.statistics.early = state.number;
  };
  turn();
}
