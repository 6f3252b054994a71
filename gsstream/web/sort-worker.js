// Sorts by depth beside the page's own thread. Messages: positions of slots or of all, and a view; the answer to a view is the order.

import { DepthSorter } from "./sorting.js";

const sorter = new DepthSorter();

self.onmessage = ({ data }) => {
  if (data.slots) sorter.update(data.slots, data.positions);
  else if (data.positions) sorter.reset(data.positions.length / 3, data.positions);
  if (data.axis) {
    const started = performance.now();
    const order = sorter.sort(data.axis, data.near);
    self.postMessage({ order, milliseconds: performance.now() - started }, [order.buffer]);
  }
};
