// Depth order of Gaussians, farthest first: a radix sort of the bits of float32 depths, two passes of 16 bits.

/** Sorts the slots that lie in front of a camera. Keeps its working memory from call to call. */
export class DepthSorter {
  constructor() {
    this.positions = new Float32Array(0);
    this.keys = new Uint32Array(0);
  }

  /** Forget all positions and make room for `capacity` slots, or take those given; one of NaN is never drawn. */
  reset(capacity, positions = new Float32Array(3 * capacity).fill(NaN)) {
    this.positions = positions;
  }

  /** Set the positions [k, 3] of `slots` [k]; NaN takes a slot out. */
  update(slots, positions) {
    for (let i = 0; i < slots.length; i += 1) {
      for (let axis = 0; axis < 3; axis += 1) this.positions[3 * slots[i] + axis] = positions[3 * i + axis];
    }
  }

  /**
   * The slots with depth above `near`, farthest first, as a new Uint32Array. `axis`: the four numbers of the row of
   * the world-to-camera matrix that gives the depth. Of equal depths the first counts as nearer, by slot, or by its
   * place in `list` where one is given: copies of a Gaussian lie at the very same place.
   */
  sort([x, y, z, offset], near, list = null) {
    if (3 * this.keys.length < this.positions.length) this._reserve(this.positions.length / 3);
    const { positions, keys, slots } = this;
    const depth = this.depth;
    const bits = new Uint32Array(depth.buffer);
    let number = 0;
    for (let i = (list ? list.length : positions.length / 3) - 1; i >= 0; i -= 1) {
      const slot = list ? list[i] : i;
      const at = 3 * slot;
      const value = x * positions[at] + y * positions[at + 1] + z * positions[at + 2] + offset;
      if (value > near) {
        depth[0] = value;
        // Positive floats are ordered as their bits are; the difference turns the order round.
        keys[number] = 0x7fffffff - bits[0];
        slots[number] = slot;
        number += 1;
      }
    }
    this._pass(keys, slots, this.keys2, this.slots2, number, 0);
    const order = new Uint32Array(number);
    this._pass(this.keys2, this.slots2, keys, order, number, 16);
    return order;
  }

  _reserve(capacity) {
    this.keys = new Uint32Array(capacity);
    this.slots = new Uint32Array(capacity);
    this.keys2 = new Uint32Array(capacity);
    this.slots2 = new Uint32Array(capacity);
    this.depth = new Float32Array(1);
    this.counts = new Uint32Array(65537);
  }

  _pass(fromKeys, fromSlots, toKeys, toSlots, number, shift) {
    const { counts } = this;
    counts.fill(0);
    for (let i = 0; i < number; i += 1) counts[((fromKeys[i] >>> shift) & 0xffff) + 1] += 1;
    for (let i = 0; i < 65536; i += 1) counts[i + 1] += counts[i];
    for (let i = 0; i < number; i += 1) {
      const at = counts[(fromKeys[i] >>> shift) & 0xffff]++;
      toKeys[at] = fromKeys[i];
      toSlots[at] = fromSlots[i];
    }
  }
}
