// The depth order of what is drawn, from a worker where there is one. At most one request is under way.

import { DepthSorter } from "./sorting.js";
import { startWorker } from "./stream-link.js";

/** Hands positions to the sorter and keeps its last answer in `order`. */
export class SortQueue {
  /** `onOrder` is called when a new order has come. `useWorker` false sorts on the calling thread. */
  constructor(onOrder, useWorker = true) {
    this.onOrder = onOrder;
    this.order = new Uint32Array(0);
    this.milliseconds = 0;
    this.busy = false;
    this.waiting = null;
    this.asked = null;
    this.worker = useWorker ? startWorker("sort-worker.js") : null;
    this.local = new DepthSorter();
    if (this.worker) {
      this.worker.onmessage = ({ data }) => this._received(data);
      this.worker.onerror = (event) => this._withoutWorker(event);
    }
  }

  /** Positions of `slots`, or of all (slots null), which replace those of before. */
  update(slots, positions) {
    this.asked = null;
    this.worker?.postMessage({ slots, positions });
    if (slots) this.local.update(slots, positions);
    else this.local.reset(positions.length / 3, positions);
  }

  /** Ask for the order of a view, unless it is known; of several requests that wait only the last is carried out. */
  request(axis, near) {
    const asked = [...axis, near].join();
    if (asked === this.asked) return;
    this.asked = asked;
    this._send(axis, near);
  }

  _send(axis, near) {
    if (!this.worker) {
      this.order = this.local.sort(axis, near);
    } else if (this.busy) {
      this.waiting = { axis, near };
    } else {
      this.busy = true;
      this.worker.postMessage({ axis, near });
    }
  }

  /** The exact order of a view at once, on this thread, equal depths as in `list`: for pictures that are measured. */
  sortNow(axis, near, list) {
    this.asked = null;
    this.order = this.local.sort(axis, near, list);
  }

  dispose() {
    this.worker?.terminate();
  }

  _received({ order, milliseconds }) {
    this.order = order;
    this.milliseconds = milliseconds;
    this.busy = false;
    const { waiting } = this;
    this.waiting = null;
    if (waiting) this._send(waiting.axis, waiting.near);
    this.onOrder();
  }

  /** A worker that does not start (a page of another origin, a strict policy) is replaced by this thread. */
  _withoutWorker(event) {
    event.preventDefault();
    this.worker = null;
    this.busy = false;
    this.asked = null;
    this.onOrder();
  }
}
