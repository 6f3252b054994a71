// Views: where a camera stands and how it looks, and how a hand moves it. Axes: x right, y down, z forward.

export const add = (a, b, factor = 1) => a.map((v, i) => v + factor * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));

/** All cameras of a stream's meta as views, test cameras first: `{ id, split, eye, right, down, forward, ... }`. */
export function viewsOf(meta) {
  return ["test", "train"].flatMap((split) => {
    const rig = meta[split];
    return rig.ids.map((id, i) => {
      const m = rig.viewmats[i];
      const [right, down, forward] = [0, 4, 8].map((row) => m.slice(row, row + 3));
      const eye = [0, 1, 2].map((k) => -(right[k] * m[3] + down[k] * m[7] + forward[k] * m[11]));
      const [fx, fy, cx, cy] = [0, 4, 2, 5].map((k) => rig.Ks[i][k]);
      const { width, height, near } = rig;
      return { id, split, eye, right, down, forward, fx, fy, cx, cy, width, height, near };
    });
  });
}

/** Pixels of a canvas for one of a view, which covers it: beside what its camera saw nothing is known. */
export function scaleOf(view, width, height) {
  return Math.max(width / view.width, height / view.height);
}

/** The camera that the renderer takes, for a canvas of `width` x `height` pixels. */
export function cameraOf(view, width, height) {
  const scale = scaleOf(view, width, height);
  const rows = [view.right, view.down, view.forward];
  const viewmat = rows.flatMap((row) => [...row, -dot(row, view.eye)]);
  return {
    viewmat: [...viewmat, 0, 0, 0, 1],
    scale,
    fx: view.fx * scale,
    fy: view.fy * scale,
    near: view.near,
    width,
    height,
    cx: view.cx * scale + (width - view.width * scale) / 2,
    cy: view.cy * scale + (height - view.height * scale) / 2,
  };
}

/** Mean squared angle between optical axes below which nothing says where they meet; the least length of their mean, of
    cameras that look one way; the weight that draws the point to the middle of the cameras. */
const [PARALLEL, ONE_WAY, TO_MIDDLE] = [1e-4, 0.9, 1e-4];

/**
 * What views turn around: the point nearest to all optical axes, the direction that is up, and whether the cameras look
 * outward, away from the point. Parallel axes leave the distance open: of cameras that look one way the point is then as
 * far before their middle as the rig is wide.
 */
export function pivotOf(views) {
  const mean = (of) => views.reduce((sum, view) => add(sum, of(view), 1 / views.length), [0, 0, 0]);
  const across = (axis, vector) => add(vector, axis, -dot(axis, vector));
  const units = [0, 1, 2].map((k) => [0, 1, 2].map((i) => Number(i === k)));
  const plain = units.map((one) => mean(({ forward }) => across(forward, one)));
  const middle = mean(({ eye }) => eye);
  const right = add(mean(({ eye, forward }) => across(forward, eye)), middle, TO_MIDDLE);
  const determinant = ([a, b, c]) => dot(a, cross(b, c));
  const up = upOf(views, mean);
  const ahead = mean(({ forward }) => forward);
  const oneWay = Math.hypot(...ahead) >= ONE_WAY;
  if (determinant(plain) >= PARALLEL || !oneWay) {
    const columns = plain.map((column, k) => add(column, units[k], TO_MIDDLE));
    const point = [0, 1, 2].map((k) => determinant(columns.map((column, i) => (i === k ? right : column))) / determinant(columns));
    const inward = views.reduce((sum, { eye, forward }) => sum - dot(add(eye, point, -1), forward), 0);
    const outward = inward <= 1e-9 * views.length;
    if (!outward || !oneWay) return { point, up, outward };
  }
  const extent = 1.1 * Math.max(...views.map(({ eye }) => Math.hypot(...add(eye, middle, -1)))) || 1;
  return { point: add(middle, unit(ahead), extent), up, outward: false };
}

/**
 * The direction across the cameras' x axes, which are level unless a camera is rolled. Their mean up direction would
 * lean towards the side from which half a circle looks down: it gives the sign, and all where the x axes are parallel.
 */
function upOf(views, meanOf) {
  let mean = meanOf(({ down }) => down.map((v) => -v));
  if (Math.hypot(...mean) < 1e-3) mean = views[0].down.map((v) => -v);
  const rows = [0, 1, 2].map((k) => meanOf(({ right }) => right.map((v) => v * right[k])));
  // Squared again and again, what is left of the identity has the direction of the smallest eigenvalue alone.
  let power = rows.map((row, i) => row.map((v, k) => (i === k) - v));
  for (let i = 0; i < 20; i += 1) {
    const size = Math.hypot(...power.flat()) || 1;
    power = power.map((row) => [0, 1, 2].map((k) => dot(row, power.map((other) => other[k])) / size ** 2));
  }
  const longest = power.reduce((best, row) => (Math.hypot(...row) > Math.hypot(...best) ? row : best));
  const axis = unit(longest);
  const up = axis.map((v) => v * Math.sign(dot(axis, mean)));
  const smallest = dot(axis, rows.map((row) => dot(row, axis)));
  // The eigenvalues sum up to 1, and their squares to that of the entries.
  const squares = rows.reduce((sum, row) => sum + dot(row, row), -(smallest ** 2));
  const middle = (1 - smallest - Math.sqrt(Math.max(0, 2 * squares - (1 - smallest) ** 2))) / 2;
  const level = smallest < 0.05 * middle && middle > 1e-3 && dot(up, mean) > 0.5 * Math.hypot(...mean);
  return level ? up : unit(mean);
}

function turned(vector, axis, angle) {
  const cosine = Math.cos(angle);
  const sine = Math.sin(angle);
  const side = cross(axis, vector);
  const along = dot(axis, vector) * (1 - cosine);
  return vector.map((v, i) => v * cosine + side[i] * sine + axis[i] * along);
}

export function turnView(view, axis, angle, point) {
  const [right, down, forward] = [view.right, view.down, view.forward].map((v) => unit(turned(v, axis, angle)));
  return { ...view, right, down, forward, eye: add(point, turned(add(view.eye, point, -1), axis, angle)) };
}

/** The tilted view, unless it goes over the top; one that looks steeply already may come back. */
function notOver(level, tilted, up) {
  const [before, after] = [level, tilted].map(({ forward }) => Math.abs(dot(forward, up)));
  return after < Math.max(0.985, before) ? tilted : level;
}

/** The view turned around the pivot by angles in radians; it never goes over the top. */
export function orbited(view, pivot, yaw, pitch) {
  const level = turnView(view, pivot.up, yaw, pivot.point);
  return notOver(level, turnView(level, level.right, pitch, pivot.point), pivot.up);
}

/** The view turned where it stands. */
export function looked(view, pivot, yaw, pitch) {
  const level = turnView(view, pivot.up, yaw, view.eye);
  return notOver(level, turnView(level, level.right, pitch, view.eye), pivot.up);
}

/** View and pivot moved along the view's own axes, in scene units. */
export function moved(view, pivot, by) {
  const step = [view.right, view.down, view.forward].reduce((sum, axis, i) => add(sum, axis, by[i]), [0, 0, 0]);
  return { view: { ...view, eye: add(view.eye, step) }, pivot: { ...pivot, point: add(pivot.point, step) } };
}

/** The view nearer to the pivot (factor below 1) or farther away. */
export function zoomed(view, pivot, factor) {
  const offset = add(view.eye, pivot.point, -1);
  const distance = Math.hypot(...offset);
  const wanted = Math.max(distance * factor, 2 * view.near);
  return { ...view, eye: add(pivot.point, offset, wanted / (distance || 1)) };
}

/** Distance of a view from its pivot, scene units. */
export function distance(view, pivot) {
  return Math.hypot(...add(view.eye, pivot.point, -1));
}
