// Where a stream's coordinates lie in those of its recording: x_recording = scale * rotation x_stream + offset.
// For scripts beside a package or a page of your own: copy this module; it imports nothing.

const IDENTITY = { rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], offset: [0, 0, 0], scale: 1 };

/** The world of a stream's meta; a stream that says nothing shares the recording's coordinates. */
export const worldOf = (meta) => meta.world ?? IDENTITY;

/** A point of the stream in the recording's coordinates. */
export function toRecording(world, point) {
  const { rotation, offset, scale } = world;
  return [0, 1, 2].map((row) => scale * dot(rotation.slice(3 * row, 3 * row + 3), point) + offset[row]);
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
