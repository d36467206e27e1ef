// Pack a scan for the viewer: positions in int16, all other values in bytes.

import { counted } from "./errors.js";
import { quantilesOf } from "./sensor/statistics.js";

const MAX_POINTS = 400_000;  // largest number of points that the viewer shows; of larger scans, every second or third point
const REACH = 500;  // the largest coordinate that the viewer shows, metres
const LEVELS = 32_767;  // the largest int16
const TITLES = { rv: "RV", bev: "BEV", ensemble: "Ensemble", amvnet: "AMVNet" };

/**
 * Return {about, scan, indices}: what the viewer needs to know, the packed scan, and the index in `points` of each
 * point that the viewer draws. They are made of a normalised scan {points, count} and of what `segment` returned for
 * it, which may be null.
 */
export function shownScan(name, { points, count }, segmentation, description) {
  const isNear = (i) => [0, 1, 2].every((axis) => Math.abs(points[4 * i + axis]) <= REACH);
  const near = Uint32Array.from({ length: points.length / 4 }, (_, i) => i).filter(isNear);
  const stride = Math.max(1, Math.ceil(near.length / MAX_POINTS)), indices = near.filter((_, place) => place % stride === 0);

  const leftOut = count - near.length, notes = [];
  if (leftOut) notes.push(`${counted(leftOut)} without a position, of the car itself or beyond ${REACH} m`);
  if (stride > 1) notes.push(`one in ${stride} of the scan`);
  const scan = { name, index: 0, count: indices.length, note: notes.join("; "), ...quantised(points, indices) };
  const byte = (value) => Math.round(Math.min(Math.max(value, 0), 1) * 255);
  const plane = (valueOf) => Uint8Array.from(indices, valueOf);
  const { scores = {}, labels = {}, similarity, uncertain } = segmentation ?? {};
  scan.planes = { intensity: plane((i) => byte(points[4 * i + 3])) };
  for (const [method, ids] of Object.entries(labels)) {
    const best = bestTwo(scores[method], indices, description.classes.length - 1);
    scan.planes[method] = plane((i) => ids[i]);
    scan.planes[`${method}-probability`] = best.firstShare;
    if (method === description.method) Object.assign(scan.planes, { second: best.second, "second-probability": best.secondShare });
  }
  if (uncertain) {
    scan.planes.uncertain = plane((i) => uncertain[i]);
    scan.planes.disagreement = plane((i) => byte(1 - similarity[i]));
  }
  return { about: aboutOf(scan, points, indices, labels, description), scan, indices };
}

/** Return {firstShare, second, secondShare} of points: the best class in percent, the second best class, its percent. */
function bestTwo(scores, indices, k) {
  const best = Object.fromEntries(["firstShare", "second", "secondShare"].map((key) => [key, new Uint8Array(indices.length)]));
  indices.forEach((i, place) => {
    const row = scores.subarray(i * k, (i + 1) * k), sum = row.reduce((a, b) => a + b);  // 1, but not of a geometric mean
    let first = 0, second = -1;
    for (let c = 1; c < k; c++) {
      if (row[c] > row[first]) [first, second] = [c, first];
      else if (second < 0 || row[c] > row[second]) second = c;
    }
    // Two networks that are wholly sure of different classes leave a score of 0 for every class.
    const percent = (c) => Math.round(100 * (sum > 0 ? row[c] / sum : 1 / k));
    best.firstShare[place] = percent(first);
    if (second < 0) return;
    best.second[place] = second + 1;
    best.secondShare[place] = percent(second);
  });
  return best;
}

/** Return {center, step, positions}: the points as int16 multiples of a step from the centre. */
function quantised(points, indices) {
  const center = [], step = [], positions = new Int16Array(3 * indices.length);
  for (let axis = 0; axis < 3; axis++) {
    let low = Infinity, high = -Infinity;
    for (const i of indices) [low, high] = [Math.min(low, points[4 * i + axis]), Math.max(high, points[4 * i + axis])];
    center[axis] = indices.length ? (low + high) / 2 : 0;
    step[axis] = Math.max((high - low) / 2, 1e-3) / LEVELS;
    indices.forEach((i, place) => (positions[3 * place + axis] = Math.round((points[4 * i + axis] - center[axis]) / step[axis])));
  }
  return { center, step, positions };
}

function aboutOf(scan, points, indices, labels, { classes, taxonomy }) {
  const quantiles = (axis, at) => quantilesOf(Float64Array.from(indices, (i) => points[4 * i + axis]).sort(), at);
  const [low, ground, high] = indices.length ? quantiles(2, [0.01, 0.1, 0.99]) : [0, 0, 1];
  const brightest = indices.length ? quantiles(3, [0.98])[0] : 1;
  const present = new Set(Object.values(labels).flatMap((ids) => [...new Set(ids)]));
  return {
    title: "AMVNet in the browser",
    classes: ["unlabelled", ...classes.slice(1).map((each) => each.name)],
    raw: classes.map((each) => each.raw_id),
    official: classes,  // they have the colours of label files
    taxonomy,
    present: [...present].sort((a, b) => a - b),
    sources: Object.keys(labels).map((key) => ({ key, title: TITLES[key] })),
    scans: [{ name: scan.name, count: scan.count, planes: Object.keys(scan.planes) }],
    ranges: { uncertainty: [0, 1], height: [low, high], intensity: [0, brightest] },
    ground,
  };
}
