// Where a stream's coordinates lie in those of its recording: x_recording = scale * rotation x_stream + offset.

const IDENTITY = { rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], offset: [0, 0, 0], scale: 1 };

/** The world of a stream's meta; a stream that says nothing shares the recording's coordinates. */
export const worldOf = (meta) => meta.world ?? IDENTITY;

/** Whether a value is a similarity: a rotation row by row, an offset and a scale above 0, all of them finite. */
export function isWorld(value) {
  if (value === null || typeof value !== "object") return false;
  const { rotation, offset, scale } = value;
  const numbers = [rotation, offset].every((list) => Array.isArray(list) && list.every(Number.isFinite));
  if (!numbers || rotation.length !== 9 || offset.length !== 3 || !(Number.isFinite(scale) && scale > 0)) return false;
  const rows = [0, 3, 6].map((at) => rotation.slice(at, at + 3));
  const square = rows.every((a, i) => rows.every((b, k) => Math.abs(dot(a, b) - (i === k)) <= 1e-6));
  const [[a, b, c], [d, e, f], [g, h, i]] = rows;
  return square && a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0;
}

/** A point of the stream in the recording's coordinates. */
export function toRecording(world, point) {
  return [0, 1, 2].map((row) => world.scale * dot(world.rotation.slice(3 * row, 3 * row + 3), point) + world.offset[row]);
}

/**
 * A view (of `viewsOf`, or a player's `view`) as four rows world to camera in the recording's coordinates: the `w2c` of
 * cameras.json, which `gsstream play --camera FILE.json` takes.
 */
export function poseInRecording(meta, view) {
  const world = worldOf(meta);
  const columns = [0, 3, 6].map((at) => world.rotation.slice(at, at + 3));
  const eye = toRecording(world, view.eye);
  const rows = [view.right, view.down, view.forward].map((axis) => {
    const turned = columns.map((row) => dot(row, axis));
    return [...turned, -dot(turned, eye)];
  });
  return [...rows, [0, 0, 0, 1]];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
