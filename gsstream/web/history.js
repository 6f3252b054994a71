// How far rows were displaced by the last frame: what a motion is predicted from, and the groups it was said of.

/** Values of `rows` in an array of `width` values a row. */
export function pick(values, rows, width) {
  const out = new Float32Array(rows.length * width);
  for (let i = 0, to = 0; i < rows.length; i += 1) {
    const from = rows[i] * width;
    for (let d = 0; d < width; d += 1, to += 1) out[to] = values[from + d];
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
    const a = 3 * rows[i];
    const o = 3 * at;
    shift[o] = scene.means[a] - means[3 * i];
    shift[o + 1] = scene.means[a + 1] - means[3 * i + 1];
    shift[o + 2] = scene.means[a + 2] - means[3 * i + 2];
    turnBetween(quats, 4 * i, scene.quats, 4 * rows[i], turn, o);
    const shifts = shift[o] !== 0 || shift[o + 1] !== 0 || shift[o + 2] !== 0;
    if (shifts || turn[o] !== 0 || turn[o + 1] !== 0 || turn[o + 2] !== 0) kept[at++] = rows[i];
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

/** The displacement of rows after Gaussians were added and removed; `source` says which of `number` rows each one was. */
export function gatherDisplacement(moved, source, number) {
  if (!moved) return null;
  const place = new Int32Array(number).fill(-1);
  for (let i = 0; i < moved.rows.length; i += 1) place[moved.rows[i]] = i;
  const rows = new Uint32Array(moved.rows.length);
  const from = new Uint32Array(moved.rows.length);
  let at = 0;
  for (let i = 0; i < source.length; i += 1) {
    if (source[i] >= number || place[source[i]] < 0) continue;
    rows[at] = i;
    from[at++] = place[source[i]];
  }
  const kept = from.subarray(0, at);
  return { rows: rows.slice(0, at), shift: pick(moved.shift, kept, 3), turn: pick(moved.turn, kept, 3) };
}

/** The groups of rows after Gaussians were added and removed: an added Gaussian joins the group of the row before it; without old rows, none. */
export function gatherGroups(groups, source, number) {
  if (!groups) return null;
  let first = 0;
  while (first < source.length && source[first] >= number) first += 1;
  if (first === source.length) return null;
  const groupOf = new Int32Array(source.length);
  let last = groups.groupOf[source[first]];
  for (let i = 0; i < source.length; i += 1) {
    if (source[i] < number) last = groups.groupOf[source[i]];
    groupOf[i] = last;
  }
  return { ...groups, groupOf };
}
