// Displacement of rows by the last frame, from which a motion is predicted, and the groups of the last motion.

/** Values of `rows` in an array of `width` values a row. */
export function gatherValues(values, rows, width) {
  const out = new Float32Array(rows.length * width);
  for (let i = 0, to = 0; i < rows.length; i += 1) {
    const from = rows[i] * width;
    for (let d = 0; d < width; d += 1, to += 1) out[to] = values[from + d];
  }
  return out;
}

/**
 * Displacement of `rows`, ascending, by a frame: `{ rows, translation, rotation }` of those that moved, or null.
 * `means` and `quats` are their values before the frame.
 */
export function displacementBetween(rows, means, quats, scene) {
  const kept = new Uint32Array(rows.length);
  const translation = new Float32Array(3 * rows.length);
  const rotation = new Float32Array(3 * rows.length);
  let at = 0;
  for (let i = 0; i < rows.length; i += 1) {
    const a = 3 * rows[i];
    const o = 3 * at;
    translation[o] = scene.means[a] - means[3 * i];
    translation[o + 1] = scene.means[a + 1] - means[3 * i + 1];
    translation[o + 2] = scene.means[a + 2] - means[3 * i + 2];
    rotationBetween(quats, 4 * i, scene.quats, 4 * rows[i], rotation, o);
    const translates = translation[o] !== 0 || translation[o + 1] !== 0 || translation[o + 2] !== 0;
    if (translates || rotation[o] !== 0 || rotation[o + 1] !== 0 || rotation[o + 2] !== 0) kept[at++] = rows[i];
  }
  if (!at) return null;
  return { rows: kept.slice(0, at), translation: translation.slice(0, 3 * at), rotation: rotation.slice(0, 3 * at) };
}

/** The rotation from one quaternion to another as axis * tan(angle / 2), in float64; of more than 120 degrees: none. */
function rotationBetween(before, b, after, a, out, o) {
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

/** The displacement after rows were added and removed; `source`: which of `number` rows each was. */
export function gatherDisplacement(displacement, source, number) {
  if (!displacement) return null;
  const place = new Int32Array(number).fill(-1);
  for (let i = 0; i < displacement.rows.length; i += 1) place[displacement.rows[i]] = i;
  const rows = new Uint32Array(displacement.rows.length);
  const from = new Uint32Array(displacement.rows.length);
  let at = 0;
  for (let i = 0; i < source.length; i += 1) {
    if (source[i] >= number || place[source[i]] < 0) continue;
    rows[at] = i;
    from[at++] = place[source[i]];
  }
  const kept = from.subarray(0, at);
  const values = (name) => gatherValues(displacement[name], kept, 3);
  return { rows: rows.slice(0, at), translation: values("translation"), rotation: values("rotation") };
}

/** The groups likewise: an added Gaussian joins the group of the row before it; without old rows, none. */
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
