// Sorts by depth beside the page's own thread. Messages: reset, update, sort; the answer to sort is the order.

import { DepthSorter } from "./sorting.js";

const sorter = new DepthSorter();

self.onmessage = ({ data }) => {
  if (data.reset !== undefined) sorter.reset(data.reset);
  if (data.slots) sorter.update(data.slots, data.positions);
  if (data.axis) {
    const started = performance.now();
    const order = sorter.sort(data.axis, data.near);
    self.postMessage({ order, milliseconds: performance.now() - started }, [order.buffer]);
  }
};
