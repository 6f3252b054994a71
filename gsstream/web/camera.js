// Views: where a camera stands and how it looks, and how a hand moves it. Axes: x right, y down, z forward.

const add = (a, b, factor = 1) => a.map((v, i) => v + factor * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));

/** All cameras of a stream's meta as views, test cameras first: `{ id, split, eye, right, down, forward, ... }`. */
export function viewsOf(meta) {
  return ["test", "train"].flatMap((split) => {
    const rig = meta[split];
    return rig.ids.map((id, i) => {
      const m = rig.viewmats[i];
      const K = rig.Ks[i];
      const [right, down, forward] = [0, 4, 8].map((row) => m.slice(row, row + 3));
      const eye = [0, 1, 2].map((k) => -(right[k] * m[3] + down[k] * m[7] + forward[k] * m[11]));
      return {
        id,
        split,
        eye,
        right,
        down,
        forward,
        fx: K[0],
        fy: K[4],
        cx: K[2],
        cy: K[5],
        width: rig.width,
        height: rig.height,
        near: rig.near,
      };
    });
  });
}

/** The camera that the renderer takes, for a canvas of `width` x `height` pixels that holds the whole view. */
export function cameraOf(view, width, height) {
  const scale = Math.min(width / view.width, height / view.height);
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

/** The point nearest to the optical axes of all views, which they turn around; and the direction that is up. */
export function pivotOf(views) {
  const matrix = [0, 0, 0, 0, 0, 0, 0, 0, 0];
  const right = [0, 0, 0];
  for (const { eye, forward } of views) {
    for (let i = 0; i < 3; i += 1) {
      for (let k = 0; k < 3; k += 1) {
        const across = (i === k) - forward[i] * forward[k];
        matrix[3 * i + k] += across;
        right[i] += across * eye[k];
      }
    }
  }
  const columns = [0, 1, 2].map((k) => [matrix[k], matrix[3 + k], matrix[6 + k]]);
  const determinant = dot(columns[0], cross(columns[1], columns[2]));
  const up = upOf(views);
  if (determinant < 1e-4 * views.length ** 3) {
    // Parallel axes, or one camera: the distance is open, and three focal lengths of it are a guess.
    const middle = views.reduce((sum, view) => add(sum, view.eye, 1 / views.length), [0, 0, 0]);
    return { point: add(middle, views[0].forward, 3), up };
  }
  const solve = (k) => {
    const changed = columns.map((column, i) => (i === k ? right : column));
    return dot(changed[0], cross(changed[1], changed[2])) / determinant;
  };
  return { point: [solve(0), solve(1), solve(2)], up };
}

/**
 * The direction across the cameras' x axes, which are level unless a camera is rolled; their mean up direction would
 * lean towards the side from which half a circle looks down. It is taken where the x axes are parallel.
 */
function upOf(views) {
  const mean = unit(views.reduce((sum, view) => add(sum, view.down, -1), [0, 0, 0]));
  let up = mean;
  // Power iteration: what is left of a vector after its parts along the x axes are taken away.
  for (let i = 0; i < 200; i += 1) {
    const along = views.reduce((sum, { right }) => add(sum, right, dot(right, up) / views.length), [0, 0, 0]);
    up = unit(add(up, along, -1));
  }
  const share = views.reduce((sum, { right }) => sum + dot(right, up) ** 2, 0) / views.length;
  return share < 0.02 && dot(up, mean) > 0.5 ? up : mean;
}

function turned(vector, axis, angle) {
  const cosine = Math.cos(angle);
  const sine = Math.sin(angle);
  const side = cross(axis, vector);
  const along = dot(axis, vector) * (1 - cosine);
  return vector.map((v, i) => v * cosine + side[i] * sine + axis[i] * along);
}

function turnView(view, axis, angle, point) {
  const [right, down, forward] = [view.right, view.down, view.forward].map((v) => unit(turned(v, axis, angle)));
  return { ...view, right, down, forward, eye: add(point, turned(add(view.eye, point, -1), axis, angle)) };
}

/** The view turned around the pivot by angles in radians; it never goes over the top. */
export function orbited(view, pivot, yaw, pitch) {
  const level = turnView(view, pivot.up, yaw, pivot.point);
  const tilted = turnView(level, level.right, pitch, pivot.point);
  return Math.abs(dot(tilted.forward, pivot.up)) < 0.985 ? tilted : level;
}

/** The view turned where it stands. */
export function looked(view, pivot, yaw, pitch) {
  const level = turnView(view, pivot.up, yaw, view.eye);
  const tilted = turnView(level, level.right, pitch, view.eye);
  return Math.abs(dot(tilted.forward, pivot.up)) < 0.985 ? tilted : level;
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
