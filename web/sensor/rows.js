// Choose the rows of the points in the range image: by laser if the lasers are known, else by elevation.

import { MIN_DISTANCE } from "./ground.js";
import { quantilesOf } from "./statistics.js";

const MAX_OUTSIDE_SHARE = 0.16;  // the largest share of points outside a field of view that is wide enough
const SAME_ANGLE = 6;  // the largest difference of the ends of two fields of view that are alike, degrees
const MIN_LASERS_SEEN = 0.75;  // the least share of a sensor's lasers that have returns in every scan
const SLOPE_SPREAD = 0.035;  // the largest mean deviation of the slopes of one laser; about 2 degrees
const MAX_RING_SPREAD = 0.2;  // the largest variance of the elevations within the rings, of all their variance
const MIN_RING_POINTS = 10;  // the least number of points of a ring whose elevation counts
const SAME_ELEVATION = 0.1;  // rings that descend by less than this are in order, degrees
const LEAST_POINTS = 64;  // the least mean number of points of a laser; fewer do not show an order
const LEAST_MEASURED = 100;  // the least number of points on which a sensor is measured
const BINS = 360;  // bins of elevation in which lasers are counted, from -90 to +90 degrees
const BIN = 180 / BINS;  // the height of a bin, degrees
const SECTORS = 180;  // sectors of azimuth in which the points of a bin are counted
const AROUND = 3;  // the number of bins to each side that are counted together
export const ANY = "any";  // the name of the sensor of weights whose training has shown sensors of all kinds

/** Return the elevation of a point, degrees above the horizon. */
export function elevationOf(x, y, z) {
  return (Math.atan2(z, Math.sqrt(x * x + y * y)) * 180) / Math.PI;
}

/** Return the elevations (n) of points (4 n), degrees above the horizon. */
function elevationsOf(points) {
  return Float64Array.from({ length: points.length / 4 }, (_, i) => elevationOf(...points.subarray(4 * i, 4 * i + 3)));
}

/** Return the row of an elevation in a view; row 0 is the highest. */
export function rowAt(elevation, { fov_up: top, fov_down: bottom, height }) {
  return Math.min(Math.max(Math.floor(((top - elevation) / (top - bottom)) * height), 0), height - 1);
}

/**
 * Return the row (n) of each point in the range image; row 0 is the highest. Return null if the weights need rings, and
 * neither the scan nor its elevations give them.
 *
 * `points` (4 n) are the valid points in the sensor's frame, `tilted` (4 n) the same with the sensor's tilt, `ring` (n)
 * are their lasers or null, and `lasers` holds what was measured of the sensor.
 */
export function rowsOf(points, tilted, ring, lasers, { view, sensor, as_is: isAsIs }) {
  const byLaser = (each) => each && Int32Array.from(each, (laser) => view.height - 1 - laser);
  if (view.rows === "laser" && hasEndsOf(lasers, sensor)) {
    const each = ring ?? lasersByOrder(tilted, view.height) ?? lasersByOrder(points, view.height);
    const highest = Math.max(...new Set(each));
    if (highest >= MIN_LASERS_SEEN * view.height && highest < view.height) return byLaser(each);
  }

  const elevations = elevationsOf(points), density = sensor.name === ANY ? densityOf(points) : null;
  if (density) return rowsByDensity(elevations, density, view.height);
  const byElevation = viewByElevation(elevations, lasers, { view, sensor, isAsIs });
  const rings = view.rows === "ring" ? byLaser(ring) : null;
  // Lasers that no data sheet describes need not be evenly spaced.
  if (!byElevation || (rings && !sensor.name)) return rings;

  const rows = Int32Array.from(elevations, (elevation) => rowAt(elevation, byElevation));
  const offs = rings && rows.map((row, i) => Math.abs(row - rings[i])).sort();
  return rings && quantilesOf(offs, [0.5])[0] < 1 ? rings : rows;
}

/**
 * Return how close together the lasers of a scan are (BINS); null if its points do not show it.
 *
 * This is the mean number of points around a bin in the sectors that have any there. Where lasers see the sky, sectors are
 * empty and do not count.
 */
function densityOf(points) {
  const distant = points.filter((_, i) => Math.hypot(...points.subarray(i - (i % 4), i - (i % 4) + 2)) > MIN_DISTANCE);
  const elevations = elevationsOf(distant);
  if (elevations.length < LEAST_MEASURED) return null;
  const counts = new Int32Array((BINS + 2 * AROUND) * SECTORS);
  elevations.forEach((elevation, i) => {
    const [x, y] = distant.subarray(4 * i, 4 * i + 2), turn = Math.atan2(y, x) / (2 * Math.PI) + 0.5;
    const sector = Math.min(Math.floor(turn * SECTORS), SECTORS - 1);
    counts[(AROUND + binOf(elevation)) * SECTORS + sector] += 1;
  });

  const [bottom, top] = quantilesOf(elevations.sort(), [0.005, 0.995]);
  const density = Float64Array.from({ length: BINS }, (_, bin) => {
    if (edgeOf(bin + 1) <= bottom || edgeOf(bin) >= top) return 0;
    let total = 0, filled = 0;
    for (let sector = 0; sector < SECTORS; sector++) {
      let here = 0;
      for (let near = bin; near <= bin + 2 * AROUND; near++) here += counts[near * SECTORS + sector];
      total += here;
      filled += here > 0;
    }
    return total / Math.max(filled, 1);
  });
  return density.some(Boolean) ? density : null;
}

/** Return the row of each elevation, so that each row has about equally many lasers. */
function rowsByDensity(elevations, density, height) {
  const below = [0];
  for (const value of density) below.push(below.at(-1) + value);
  return Int32Array.from(elevations, (elevation) => {
    const bin = binOf(elevation), share = below[bin] + (density[bin] / BIN) * (elevation - edgeOf(bin));
    return Math.min(Math.max(Math.floor((1 - share / below.at(-1)) * height), 0), height - 1);
  });
}

/** Return the lower end of a bin, degrees. */
function edgeOf(bin) {
  return bin * BIN - 90;
}

function binOf(elevation) {
  return Math.min(Math.floor((elevation + 90) / BIN), BINS - 1);
}

/**
 * Return {ring, fault}: rings (n) of points (4 n) that ascend with the elevations, and what was wrong in words.
 *
 * A ring column is a claim that the elevations must confirm: a laser has one elevation, and the lasers ascend. Rings in
 * another order are put in order. `ring` is null if there are none, or none that follow the elevations.
 */
export function orderRings(points, ring) {
  if (!ring) return { ring, fault: "" };
  const seen = Array.from(ring, (index, i) => {
    const [x, y, z] = points.subarray(4 * i, 4 * i + 3), radius = Math.hypot(x, y);
    return { index, radius, waves: [x / radius, y / radius], elevation: elevationOf(x, y, z) };
  });
  const countsOf = (some) => some.reduce((counts, { index }) => counts.set(index, (counts.get(index) ?? 0) + 1), new Map());
  const distant = countsOf(seen.filter(({ radius }) => radius > MIN_DISTANCE));
  // The place of a laser that sees only the car is that of these points.
  const used = seen.filter(({ index, radius }) => radius > MIN_DISTANCE || (!distant.has(index) && radius > 0)), counts = countsOf(used);
  if (counts.size < 2 || used.length < MIN_RING_POINTS * counts.size) return { ring, fault: "" };

  const meansOf = (valueOf) => {
    const sums = new Map();
    for (const point of used) sums.set(point.index, (sums.get(point.index) ?? 0) + valueOf(point) / counts.get(point.index));
    return sums;
  };
  // A tilt of the sensor adds one wave around the sensor to the elevations of all lasers.
  const values = [({ waves }) => waves[0], ({ waves }) => waves[1], ({ elevation }) => elevation];
  const within = values.map((valueOf) => [valueOf, meansOf(valueOf)]);
  const product = (a, b) => used.reduce((sum, point) => {
    const [p, q] = [within[a], within[b]].map(([valueOf, means]) => valueOf(point) - means.get(point.index));
    return sum + p * q;
  }, 0);
  const [xx, xy, yy, xe, ye] = [product(0, 0), product(0, 1), product(1, 1), product(0, 2), product(1, 2)];
  const area = xx * yy - xy * xy, tilt = area ? [(xe * yy - ye * xy) / area, (ye * xx - xe * xy) / area] : [0, 0];
  for (const point of used) point.elevation -= tilt[0] * point.waves[0] + tilt[1] * point.waves[1];

  const means = meansOf(({ elevation }) => elevation), squares = (offOf) => used.reduce((sum, point) => sum + offOf(point) ** 2, 0);
  const mean = used.reduce((sum, { elevation }) => sum + elevation, 0) / used.length;
  const spread = squares(({ index, elevation }) => elevation - means.get(index));
  if (spread > MAX_RING_SPREAD * squares(({ elevation }) => elevation - mean)) {
    return { ring: null, fault: "rings that do not follow the elevations (not used)" };
  }

  const occurring = [...counts.keys()].sort((a, b) => a - b);
  const ascending = occurring.filter((index) => distant.get(index) >= MIN_RING_POINTS).map((index) => means.get(index));
  if (!falls(ascending)) return { ring, fault: "" };
  const isReversed = !falls(ascending.map((value) => -value)), highest = Math.max(...new Set(ring));
  const byElevation = [...occurring].sort((a, b) => means.get(a) - means.get(b));
  const lasers = new Map(byElevation.map((index, place) => [index, occurring[place]]));
  const laserOf = (index) => isReversed ? highest - index : lasers.get(index) ?? index;
  const known = isReversed ? "rings that count from the highest laser" : "rings in another order than the elevations";
  return { ring: Int32Array.from(ring, laserOf), fault: `${known} (put in order)` };
}

/** Return whether an elevation lies clearly below an earlier one. */
function falls(elevations) {
  let highest = -Infinity;
  return elevations.some((value) => (highest = Math.max(highest, value)) - value > SAME_ELEVATION);
}

/**
 * Return the laser (n) of each point (4 n), 0 the lowest; null if the order of the points does not show it.
 *
 * KITTI's files hold one laser after the other, from the highest to the lowest. Each laser begins at the front (+x) and
 * turns to the left. So the next laser begins where the azimuth passes the front from right to left. The order counts
 * only if it gives exactly as many lasers as the sensor has, and each laser keeps to one elevation, below the laser
 * before it.
 */
function lasersByOrder(points, lasers) {
  const count = points.length / 4, order = new Int32Array(count), found = [[]];
  if (count < LEAST_POINTS * lasers) return null;

  let wasRight = false;
  for (let i = 0; i < count; i++) {
    const [x, y, z] = points.subarray(4 * i, 4 * i + 3), slope = z / Math.hypot(x, y);
    if (Number.isFinite(slope)) {  // a point on the axis has no slope; it gets the laser of the point before it
      if (wasRight && x > 0 && y >= 0) found.push([]);
      found.at(-1).push(slope);
      wasRight = x > 0 && y < 0;
    }
    order[i] = found.length - 1;
  }
  if (found.length !== lasers) return null;

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const means = found.map(mean);
  const isFalling = means.every((value, place) => place === 0 || value < means[place - 1]);
  const deviation = (slopes, place) => mean(slopes.map((slope) => Math.abs(slope - means[place])));
  const isSteady = found.every((slopes, place) => deviation(slopes, place) <= SLOPE_SPREAD);
  return isFalling && isSteady ? order.map((place) => lasers - 1 - place) : null;
}

/**
 * Return the view of the weights, with the sensor's field of view if too many points are outside of it; null if rings
 * cannot be told from elevations.
 */
function viewByElevation(elevations, lasers, { view, sensor, isAsIs }) {
  const trained = endsOf(sensor), measured = endsOf(lasers);
  let used = view;
  if (view.rows === "ring") {
    // The highest laser gets the first row, the lowest laser gets the last row.
    const ends = trained ?? (lasers.beams === view.height ? measured : null);
    if (!ends) return null;
    used = between(view, ends, view.height - 1);
  }
  if (isAsIs && hasEndsOf(lasers, sensor)) return used;

  const outside = elevations.filter((elevation) => elevation > used.fov_up || elevation < used.fov_down).length;
  return outside < MAX_OUTSIDE_SHARE * elevations.length || !measured ? used : between(view, measured, view.height);
}

/** Return a view between two elevations that is wider by half a step at each end, so that the lasers lie inside. */
function between(view, [top, bottom], steps) {
  const half = (top - bottom) / (2 * steps);
  return { ...view, fov_up: top + half, fov_down: bottom - half };
}

function endsOf({ fov_up: top, fov_down: bottom }) {
  return top === null || bottom === null || top <= bottom ? null : [top, bottom];
}

/** Return whether two fields of view are alike; ends that are not known count as alike. */
export function hasEndsOf(a, b, angle = SAME_ANGLE) {
  return ["fov_up", "fov_down"].every((end) => a[end] === null || b[end] === null || Math.abs(a[end] - b[end]) <= angle);
}
