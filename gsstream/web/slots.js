// Where rows of the scene lie in the renderer's memory. Births and deaths shift rows, but move nothing that is there.

/** A row keeps its slot for as long as it lives; slots of the dead are given to the born. */
export class Slots {
  constructor() {
    this.reset(0);
  }

  /** Rows 0 to `number` - 1 in slots of the same number. */
  reset(number) {
    this.slotOf = Uint32Array.from({ length: number }, (_, row) => row);
    this.rowOf = Int32Array.from(this.slotOf);
    this.used = number;
    this.free = [];
  }

  /**
   * Follow births and deaths: `source` says which of `before` rows each row was; beyond are births.
   *
   * Returns `{ born, dead }`, lists of slots.
   */
  follow(source, before) {
    const slotOf = new Uint32Array(source.length);
    const lives = new Uint8Array(before);
    const births = [];
    source.forEach((row, i) => {
      if (row < before) {
        slotOf[i] = this.slotOf[row];
        lives[row] = 1;
      } else {
        births.push(i);
      }
    });
    const dead = [];
    for (let row = 0; row < before; row += 1) if (!lives[row]) dead.push(this.slotOf[row]);
    this.free.push(...dead);
    const born = births.map((i) => {
      slotOf[i] = this.free.length ? this.free.pop() : this.used++;
      return slotOf[i];
    });
    const alive = new Set(born);
    this.slotOf = slotOf;
    this.rowOf = new Int32Array(this.used).fill(-1);
    slotOf.forEach((slot, row) => {
      this.rowOf[slot] = row;
    });
    return { born, dead: dead.filter((slot) => !alive.has(slot)) };
  }
}
