// Choose the rows of the points in the range image: by laser if the lasers are known, else by elevation.

const OUTSIDE = 0.16;  // the largest share of points outside a field of view that is wide enough
const SAME_ANGLE = 6;  // the largest difference of the ends of two fields of view that are alike, degrees
const LASERS_SEEN = 0.75;  // the least share of a sensor's lasers that have returns in every scan
const SLOPE_SPREAD = 0.035;  // the largest mean deviation of the slopes of one laser; about 2 degrees
const LEAST_POINTS = 64;  // the least mean number of points of a laser; fewer do not show an order

/** Return the elevation of a point, degrees above the horizon. */
export function elevationOf(x, y, z) {
  return (Math.atan2(z, Math.sqrt(x * x + y * y)) * 180) / Math.PI;
}

/** Return the row of an elevation in a view; row 0 is the highest. */
export function rowAt(elevation, { fov_up: top, fov_down: bottom, height }) {
  return Math.min(Math.max(Math.floor(((top - elevation) / (top - bottom)) * height), 0), height - 1);
}

/**
 * Return the row (n) of each point in the range image; row 0 is the highest. Return null if the weights need rings, and
 * neither the scan nor its elevations give them.
 *
 * `points` (4 n) are the valid points in the sensor's frame, `places` (n) are their places in the cloud, and `lasers`
 * holds what was measured of the sensor.
 */
export function rowsOf(points, places, cloud, lasers, { view, sensor, as_is: isAsIs }) {
  const byLaser = (ring) => ring && Int32Array.from(places, (place) => view.height - 1 - ring[place]);
  if (view.rows === "laser" && hasEndsOf(lasers, sensor)) {
    const ring = cloud.ring ?? lasersByOrder(cloud.xyz, view.height), highest = ring ? Math.max(...new Set(ring)) : -1;
    if (highest >= LASERS_SEEN * view.height && highest < view.height) return byLaser(ring);
  }

  const elevations = Float64Array.from(places, (_, i) => elevationOf(...points.subarray(4 * i, 4 * i + 3)));
  const byElevation = viewByElevation(elevations, lasers, { view, sensor, isAsIs });
  const rings = view.rows === "ring" ? byLaser(cloud.ring) : null;
  // Lasers that no data sheet describes need not be evenly spaced.
  if (!byElevation || (rings && !sensor.name)) return rings;

  const rows = Int32Array.from(elevations, (elevation) => rowAt(elevation, byElevation));
  const isRing = rings && rows.filter((row, i) => row === rings[i]).length >= rows.length / 2;
  return isRing ? rings : rows;
}

/**
 * Return the laser (n) of each point (3 n), 0 the lowest; null if the order of the points does not show it.
 *
 * KITTI's files hold one laser after the other, from the highest to the lowest. Each laser begins at the front (+x) and
 * turns to the left. So the next laser begins where the azimuth passes the front from right to left. The order counts
 * only if it gives exactly as many lasers as the sensor has, and each laser keeps to one elevation, below the laser
 * before it.
 */
export function lasersByOrder(xyz, lasers) {
  const count = xyz.length / 3, order = new Int32Array(count), found = [[]];
  if (count < LEAST_POINTS * lasers) return null;

  let wasRight = false;
  for (let i = 0; i < count; i++) {
    const [x, y, z] = xyz.subarray(3 * i, 3 * i + 3), slope = z / Math.hypot(x, y);
    if (Number.isFinite(slope)) {  // a lost return at the origin has no slope; it gets the laser of the point before it
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
  return outside < OUTSIDE * elevations.length || !measured ? used : between(view, measured, view.height);
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
export function hasEndsOf(a, b) {
  return ["fov_up", "fov_down"].every((end) => a[end] === null || b[end] === null || Math.abs(a[end] - b[end]) <= SAME_ANGLE);
}
