// The region that cameras have recorded: the rule of gsstream/player/region.py, whose limits tests compare with these.

import { add, cross, dot, turnView, unit } from "./camera.js";

const OPEN_GAP = Math.PI / 2;
const MIN_SWING = Math.PI / 18;
const SLACK = Math.PI / 18;
const SLACK_FACTOR = Math.log(1.3);
const [NEAREST, FARTHEST] = [0.5, 1.5];
const STEEP = Math.cos(Math.PI / 18);
const [CUT, TIE] = [1, 1e-9];
const TURN = 2 * Math.PI;

const modulo = (a, b) => ((a % b) + b) % b;
const wrapped = (angle) => modulo(angle + Math.PI, TURN) - Math.PI;

/** `{ azimuth: [middle, half] or null, elevation: [low, high], distance: [near, far] }` of views around their pivot. */
export function regionOf(views, pivot) {
  const arms = views.map((view) => armOf(view, pivot));
  const elevations = arms.map((arm) => anglesOf(arm, pivot).elevation);
  const [low, high] = [Math.min(...elevations), Math.max(...elevations)];
  const half = Math.max((high - low) / 2, MIN_SWING);
  const level = arms.filter((arm) => Math.abs(dot(arm, pivot.up)) < STEEP);
  const distances = views.map(({ eye }) => Math.hypot(...add(eye, pivot.point, -1)));
  return {
    azimuth: level.length ? arcOf(level.map((arm) => anglesOf(arm, pivot).azimuth)) : null,
    elevation: [(low + high) / 2 - half, (low + high) / 2 + half],
    distance: [NEAREST * Math.min(...distances), FARTHEST * Math.max(...distances)],
    focus: pivot.point,
  };
}

function armOf(view, pivot) {
  if (pivot.outward) return view.forward;
  const offset = add(view.eye, pivot.point, -1);
  return Math.hypot(...offset) > 0 ? unit(offset) : view.forward.map((v) => -v);
}

function anglesOf(arm, { up }) {
  const axis = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const first = unit(add(axis, up, -dot(axis, up)));
  const azimuth = Math.atan2(dot(arm, cross(up, first)), dot(arm, first));
  return { azimuth, elevation: Math.asin(Math.max(-1, Math.min(1, dot(arm, up)))) };
}

function arcOf(azimuths) {
  const places = azimuths.map((angle) => modulo(angle - CUT, TURN)).sort((a, b) => a - b);
  const gaps = places.map((place, i) => (places[i + 1] ?? places[0] + TURN) - place);
  const most = Math.max(...gaps);
  if (most <= OPEN_GAP + TIE) return null;
  const widest = gaps.findIndex((gap) => gap >= most - TIE);
  const half = (TURN - gaps[widest]) / 2;
  return [wrapped(places[(widest + 1) % places.length] + half + CUT), Math.max(half, MIN_SWING)];
}

/** How far beyond a range a value is, with its sign. */
const beyond = (value, low, high) => Math.max(value - high, 0) + Math.min(value - low, 0);

/** What a view is beyond the limits, each as a share of the width in which the picture fades. */
function excess(region, view, pivot) {
  const arm = armOf(view, pivot);
  const { azimuth, elevation } = anglesOf(arm, pivot);
  const checked = region.azimuth && Math.abs(dot(arm, pivot.up)) < STEEP;
  const [near, far] = region.distance.map(Math.log);
  const distance = Math.log(Math.max(Math.hypot(...add(view.eye, pivot.point, -1)), 1e-300));
  return {
    azimuth: checked ? beyond(wrapped(azimuth - region.azimuth[0]), -region.azimuth[1], region.azimuth[1]) / SLACK : 0,
    elevation: beyond(elevation, ...region.elevation) / SLACK,
    distance: region.distance[1] > 0 ? beyond(distance, near, far) / SLACK_FACTOR : 0,
  };
}

/** 0 within the region, 1 where nothing of the picture is left. */
export function outside(region, view, pivot) {
  return Math.min(1, Math.max(...Object.values(excess(region, view, pivot)).map(Math.abs)));
}

/** View and pivot brought back by a share of what they are beyond the limits and `slack` (1: where all is faded). */
export function returned(region, view, pivot, slack, share = 1) {
  const away = add(pivot.point, region.focus, -1);
  const length = Math.hypot(...away);
  const back = Math.min(0, region.distance[0] / (length || 1) - 1);
  const point = add(pivot.point, away, back);
  let at = { ...view, eye: add(view.eye, away, back) };
  const to = { ...pivot, point };
  const over = excess(region, at, to);
  const undo = (value) => -share * beyond(value, -slack, slack);
  if (undo(over.azimuth)) at = turnView(at, to.up, undo(over.azimuth) * SLACK, point);
  if (undo(over.elevation)) {
    const axis = cross(armOf(at, to), to.up);
    at = turnView(at, Math.hypot(...axis) > 1e-6 ? unit(axis) : at.right, undo(over.elevation) * SLACK, point);
  }
  const factor = Math.exp(undo(over.distance) * SLACK_FACTOR);
  return { view: { ...at, eye: add(point, add(at.eye, point, -1), factor) }, pivot: to };
}
