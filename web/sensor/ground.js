// Find the ground in a scan: the plane that holds most of the lowest points around the sensor.

import { quantilesOf, seededRandom } from "./statistics.js";

export const MIN_DISTANCE = 1.0;  // the least distance of points that are used, metres; the vehicle is nearer
const CELL_SIDE = 1.0;  // the side of the cells whose lowest points are used, metres
const MAX_DISTANCE = 20.0;  // the largest distance of points that are used, metres
const HALF_WEIGHT = 8.0;  // the distance at which a cell has half the weight of a cell at the sensor, metres
const TRIED_PLANES = 400;  // the number of planes that are tried, each through three low points
const MIN_AREA = 1.0;  // the least area of the parallelogram that the three points span, square metres
const TOLERANCE = 0.1;  // the largest distance from the plane to a point of the ground, metres
const MAX_SLOPE = 25.0;  // the largest slope of the ground, degrees; walls and embankments are steeper
const MIN_CELLS = 30;  // the least number of cells with points
const MIN_AGREEMENT = 0.25;  // the least weighted share of the cells that lie in the plane

// The ground under the sensor may lie off the plane, where a road is curved.
const NEAR_CELLS = 60;  // the number of cells that show the ground under the sensor
const MAX_NEAR_OFF = 0.5;  // the largest distance from the plane to their lowest points, metres

// These limits tell which side of the plane is up: things stand on the ground, and there is little below it.
const MAX_OFF_PLANE = 0.3;  // the largest distance from the plane to its points, at the sensor, metres
const OFF_PLANE_PER_METRE = 0.02;  // how much this distance grows for each metre from the sensor, metres
const MAX_BELOW = 0.1;  // the largest share of points below the plane, unless more are above it
const MIN_HEIGHT = -0.5, MAX_HEIGHT = 10.0;  // the limits of the origin's height, metres; a plane above it must be sure

// These limits tell whether a plane is sure enough to level a scan by it.
const SURE_AGREEMENT = 0.3;  // the least weighted share of the cells that lie in the plane
const SURE_CELLS = 40;  // the least area of these cells, weighted by distance, square metres
const SURE_SHARE = 0.2;  // the least share of the points within MAX_DISTANCE that lie in the plane

/**
 * Return {up, height, isSure} of the ground in points (3 n: x, y, z in metres) whose z axis points roughly up: the unit
 * normal of the ground, the height of the origin over it in metres, and whether it is sure; null if there is no ground.
 */
export function findGround(xyz) {
  const points = [];
  for (let i = 0; i < xyz.length; i += 3) {
    const [x, y, z] = [xyz[i], xyz[i + 1], xyz[i + 2]], distance = Math.hypot(x, y);
    if (distance > MIN_DISTANCE) points.push({ x, y, z, distance });
  }
  const around = points.filter(({ distance }) => distance < MAX_DISTANCE), low = lowestPoints(around);
  if (low.length < MIN_CELLS) return null;

  let plane = bestPlane(low), ground = [];
  if (!plane) return null;
  for (let round = 0; round < 3; round++) {
    ground = low.filter((point) => Math.abs(offPlane(point, plane)) < TOLERANCE);
    if (ground.length < MIN_CELLS / 2) return null;
    plane = fitted(ground);
  }

  const agreement = weightOf(ground) / weightOf(low);
  const inPlane = around.filter((point) => Math.abs(offPlane(point, plane)) < TOLERANCE).length / around.length;
  const [above, below] = sides(points, plane);
  const isFirm = agreement > SURE_AGREEMENT && weightOf(ground) > SURE_CELLS;
  const isSure = isFirm && inPlane > SURE_SHARE && above >= below;

  // A plane above the origin may be a ceiling, or the lower ends of far walls.
  const [a, b, c] = plane, height = -c;
  const isCommon = height < MAX_HEIGHT && below <= Math.max(above, MAX_BELOW);
  const isBelow = height > MIN_HEIGHT ? isCommon : isSure && below < above / 2;
  if (agreement <= MIN_AGREEMENT || !isBelow) return null;
  const length = Math.hypot(a, b, 1), off = offPlaneAtSensor(low, plane);
  const up = [-a / length, -b / length, 1 / length];
  return { up, height: Math.abs(off) > TOLERANCE ? height - off : height, isSure };
}

/** Return how far above a plane the low points nearest to the sensor lie, metres. */
function offPlaneAtSensor(low, plane) {
  const mayBeGround = low.filter((point) => Math.abs(offPlane(point, plane)) < MAX_NEAR_OFF);
  const near = mayBeGround.sort((a, b) => a.distance - b.distance).slice(0, NEAR_CELLS);
  return quantilesOf(near.map((point) => offPlane(point, plane)).sort((a, b) => a - b), [0.5])[0];
}

function offPlane({ x, y, z }, [a, b, c]) {
  return z - (a * x + b * y + c);
}

function weightOf(points) {
  return points.reduce((sum, { weight }) => sum + weight, 0);
}

/** Return the shares of the points that are clearly above and below a plane. */
function sides(points, plane) {
  let above = 0, below = 0;
  for (const point of points) {
    const off = offPlane(point, plane), least = MAX_OFF_PLANE + OFF_PLANE_PER_METRE * point.distance;
    if (off > least) above++;
    if (off < -least) below++;
  }
  return [above / points.length, below / points.length];
}

/** Return the lowest point of each cell around the sensor with its weight; near points have more weight. */
function lowestPoints(points) {
  const lowest = new Map(), cells = (2 * MAX_DISTANCE) / CELL_SIDE + 1;
  for (const point of points) {
    const cell = Math.floor((point.x + MAX_DISTANCE) / CELL_SIDE) * cells + Math.floor((point.y + MAX_DISTANCE) / CELL_SIDE);
    if (!(point.z >= lowest.get(cell)?.z)) lowest.set(cell, point);
  }
  const ascending = [...lowest].sort(([a], [b]) => a - b);
  return ascending.map(([, point]) => ({ ...point, weight: 1 / (1 + point.distance / HALF_WEIGHT) }));
}

/** Return [a, b, c] of the plane z = a x + b y + c that agrees with most low points; null if all are too steep. */
function bestPlane(low) {
  const draw = seededRandom(), ends = [];
  low.reduce((sum, { weight }) => (ends.push(sum + weight), sum + weight), 0);
  const drawn = () => {
    const place = draw() * ends.at(-1);
    return low[ends.findIndex((end) => end > place)] ?? low.at(-1);
  };

  let best = null, most = -Infinity;
  for (let attempt = 0; attempt < TRIED_PLANES; attempt++) {
    const plane = planeThrough(drawn(), drawn(), drawn());
    if (!plane || !(Math.hypot(plane[0], plane[1]) < Math.tan((MAX_SLOPE * Math.PI) / 180))) continue;
    let agreeing = 0;
    for (const point of low) {
      const off = offPlane(point, plane);
      if (Math.abs(off) < TOLERANCE) agreeing += point.weight;
      else if (off < -3 * TOLERANCE) agreeing -= point.weight;
    }
    if (agreeing > most) [best, most] = [plane, agreeing];
  }
  return best;
}

/** Return the plane through three points; null if they are nearly on a line. */
function planeThrough(p, q, r) {
  const [qx, qy, qz, rx, ry, rz] = [q.x - p.x, q.y - p.y, q.z - p.z, r.x - p.x, r.y - p.y, r.z - p.z];
  const area = qx * ry - qy * rx;
  if (!(Math.abs(area) > MIN_AREA)) return null;
  const a = (qz * ry - qy * rz) / area, b = (qx * rz - qz * rx) / area;
  return [a, b, p.z - a * p.x - b * p.y];
}

/** Return the plane through points by least squares. */
function fitted(points) {
  const [x, y, z] = ["x", "y", "z"].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
  const sum = (valueOf) => points.reduce((total, point) => total + valueOf(point.x - x, point.y - y, point.z - z), 0);
  const xx = sum((dx) => dx * dx), xy = sum((dx, dy) => dx * dy), yy = sum((dx, dy) => dy * dy);
  const xz = sum((dx, _, dz) => dx * dz), yz = sum((_, dy, dz) => dy * dz), area = xx * yy - xy * xy;
  const a = (xz * yy - yz * xy) / area, b = (yz * xx - xz * xy) / area;
  return [a, b, z - a * x - b * y];
}
