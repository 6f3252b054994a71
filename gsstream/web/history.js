// How far rows were displaced by the last frame: what a motion is predicted from, and the groups it was said of.

/** Values of `rows` in an array of `width` values a row. */
export function pick(values, rows, width) {
  const out = new Float32Array(rows.length * width);
  for (let i = 0; i < rows.length; i += 1) {
    for (let d = 0; d < width; d += 1) out[i * width + d] = values[rows[i] * width + d];
  }
  return out;
}

/**
 * What a frame did to `rows`, ascending, all that it may have touched: `{ rows, shift, turn }` of those that moved, or
 * null when none did. `means` and `quats` are the values of these rows before the frame.
 */
export function displacement(rows, means, quats, scene) {
  const kept = new Uint32Array(rows.length);
  const shift = new Float32Array(3 * rows.length);
  const turn = new Float32Array(3 * rows.length);
  let at = 0;
  for (let i = 0; i < rows.length; i += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      shift[3 * at + axis] = scene.means[3 * rows[i] + axis] - means[3 * i + axis];
    }
    turnBetween(quats, 4 * i, scene.quats, 4 * rows[i], turn, 3 * at);
    let moves = false;
    for (let axis = 3 * at; axis < 3 * at + 3; axis += 1) moves ||= shift[axis] !== 0 || turn[axis] !== 0;
    if (moves) kept[at++] = rows[i];
  }
  return at ? { rows: kept.slice(0, at), shift: shift.slice(0, 3 * at), turn: turn.slice(0, 3 * at) } : null;
}

/** The rotation from one quaternion to another as axis * tan(angle / 2), in float64; of more than 120 degrees: none. */
function turnBetween(before, b, after, a, out, o) {
  const w0 = before[b];
  const x0 = before[b + 1];
  const y0 = before[b + 2];
  const z0 = before[b + 3];
  const w1 = after[a];
  const x1 = after[a + 1];
  const y1 = after[a + 2];
  const z1 = after[a + 3];
  const w = w1 * w0 + x1 * x0 + y1 * y0 + z1 * z0;
  const size = (w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0) * (w1 * w1 + x1 * x1 + y1 * y1 + z1 * z1);
  const known = w !== 0 && 4 * (w * w) >= size;
  out[o] = known ? (x1 * w0 - w1 * x0 - y1 * z0 + z1 * y0) / w : 0;
  out[o + 1] = known ? (y1 * w0 - w1 * y0 + x1 * z0 - z1 * x0) / w : 0;
  out[o + 2] = known ? (z1 * w0 - w1 * z0 - x1 * y0 + y1 * x0) / w : 0;
}

/** The displacement of rows after births and deaths; `source` says which of `number` rows each one was. */
export function gatherDisplacement(moved, source, number) {
  if (!moved) return null;
  const place = new Int32Array(number).fill(-1);
  moved.rows.forEach((row, i) => {
    place[row] = i;
  });
  const rows = [];
  const from = [];
  for (let i = 0; i < source.length; i += 1) {
    if (source[i] < number && place[source[i]] >= 0) {
      rows.push(i);
      from.push(place[source[i]]);
    }
  }
  return { rows: Uint32Array.from(rows), shift: pick(moved.shift, from, 3), turn: pick(moved.turn, from, 3) };
}

/** The groups of rows after births and deaths: a birth joins the group of the row before it; without old rows, none. */
export function gatherGroups(groups, source, number) {
  const first = source.find((row) => row < number);
  if (!groups || first === undefined) return null;
  const groupOf = new Int32Array(source.length);
  let last = groups.groupOf[first];
  for (let i = 0; i < source.length; i += 1) {
    if (source[i] < number) last = groups.groupOf[source[i]];
    groupOf[i] = last;
  }
  return { ...groups, groupOf };
}
