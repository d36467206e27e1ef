// Find the frame of a scan file: its unit, its axes, its tilt, and the height of the sensor.

import { InputError } from "../errors.js";
import { findGround, MIN_DISTANCE } from "./ground.js";
import { quantilesOf } from "./statistics.js";

// Matrices that turn a file's x, y, z into forward, left, up.
const AXES = {
  "x-forward": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  // x forward, y left, z up: ROS, KITTI
  "z-forward": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],  // x right, y down, z forward: cameras
  "z-down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  // x forward, y right, z down: aircraft
  "y-up": [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],  // x right, y up, z backward: computer graphics
};
const UP_AXES = ["z-down", "z-forward", "y-up"];  // the axes to try if no ground is found below
export const UNITS = { m: 1, mm: 0.001 };  // the length of each unit, metres

// The median distance of the points tells the unit. In metres, it is 2 to 40 with all sensors. Between the two limits,
// the unit may be centimetres or millimetres.
const MAX_METRES_MEDIAN = 200;  // the largest median distance of a scan in metres
const MIN_MILLIMETRES_MEDIAN = 4000;  // the least median distance of a scan in millimetres
// The largest ratio of near distances (quantile 0.05) to far ones (0.95) of a scan whose origin is near the sensor.
const AROUND_SHARE = 0.5;

const SAME_TILT = 3.5;  // the largest tilt that is kept, degrees; in the datasets, roads slope by up to 3.1
const SAME_HEIGHT = 0.15;  // the largest difference of height that is kept, metres; the training varies it as much
const ON_GROUND_HEIGHT = 0.3;  // the least height of a sensor, metres; a lower origin lies on the ground
// Below this height, the lasers tell whether the origin is a low sensor or the foot of a vehicle.
const LOW_HEIGHT = 0.6;
const STANDING_HEIGHT = 0.3;  // the least height over the ground of points that tell, metres
const RAISED = Array.from({ length: 13 }, (_, i) => 0.6 + 0.15 * i);  // heights over the origin to seek sensors at, metres
const LESS_SHARP = 0.75;  // the largest ratio of the sharpness of the lasers from the origin to that from above, if it is apart
const SHARP_SECTORS = 60, SHARP_BINS = 3600, BINS_TOGETHER = 20;  // the bins that tell whether points lie on lasers
const MAX_SENSOR_HEIGHT = 4.5;  // the largest height of a sensor on a vehicle, metres; beyond it, the unit may be feet

const degrees = (radians) => (radians * 180) / Math.PI;

/**
 * Return the frame {unit, axes, pitch, roll, height, tilt, isApart} of points (3 n), none of them lost. A rotation by
 * pitch and roll, in degrees, levels the scan. The height of the origin over the ground is in metres, or null without a
 * ground; it is apart if the lasers show that it is not the sensor.
 */
export function findFrame(xyz, name) {
  const frame = { unit: unitOf(xyz, name), axes: "x-forward", pitch: 0, roll: 0, height: null, tilt: 0, isApart: false };
  let level = toLevel(xyz, frame), ground = findGround(level);
  if (!ground) {
    frame.axes = axesOf(level);
    level = turned(level, AXES[frame.axes]);
    ground = findGround(level);
  }
  if (!ground) return frame;

  frame.tilt = degrees(Math.acos(Math.min(ground.up[2], 1)));
  // An unsure plane that is tilted may be a bank beside the sensor, which shows no height.
  if (!ground.isSure && frame.tilt > SAME_TILT) return frame;
  frame.height = ground.height;
  if (frame.tilt > SAME_TILT) {
    // The ground is found a second time in the level scan, whose cells have other lowest points.
    const turn = rotation(...levelling(ground.up)), again = findGround(turned(level, turn));
    const up = again ? [0, 1, 2].map((axis) => dot([0, 1, 2].map((row) => turn[row][axis]), again.up)) : ground.up;
    [frame.pitch, frame.roll] = levelling(up);
    frame.height = (again ?? ground).height;
  } else if (frame.height >= ON_GROUND_HEIGHT && frame.height < LOW_HEIGHT) {
    frame.isApart = isApart(level, ground);
  }
  if (frame.height > MAX_SENSOR_HEIGHT) {
    throw new InputError(
      `${name}: expected a sensor at most ${MAX_SENSOR_HEIGHT} m over the ground, found ${frame.height.toFixed(1)}; ` +
      "label it with amvnet predict and --unit ft if these are feet, else --height",
    );
  }
  return frame;
}

/** Return points (3 n) in metres and in the package's axes. */
export function toLevel(xyz, { unit, axes, pitch, roll }) {
  if (unit === "m" && axes === "x-forward" && !pitch && !roll) return xyz;
  const columns = [0, 1, 2].map((column) => AXES[axes].map((row) => row[column]));
  const turn = rotation(pitch, roll).map((row) => columns.map((column) => dot(row, column)));
  const metres = Float64Array.from(xyz, (value) => value * UNITS[unit]);
  return turned(metres, turn);
}

/** Return whether the origin of the coordinates lies on or below the ground. */
export function isOnGround(frame) {
  return frame.height !== null && frame.height < (frame.isApart ? LOW_HEIGHT : ON_GROUND_HEIGHT);
}

/** Return whether the lasers of points (3 n) that stand on the ground are clearly sharper from above the origin. */
function isApart(level, { up, height }) {
  const isStanding = (i) => dot(level.subarray(i, i + 3), up) + height * up[2] > STANDING_HEIGHT;
  const standing = level.filter((_, place) => isStanding(place - (place % 3)));
  return sharpnessOf(standing, 0) < LESS_SHARP * Math.max(...RAISED.map((rise) => sharpnessOf(standing, rise)));
}

/** Return how much points (3 n), seen from a height over the origin, gather at the same elevations, as a laser's do. */
function sharpnessOf(xyz, rise) {
  const counts = new Float64Array(SHARP_SECTORS * SHARP_BINS);
  for (let i = 0; i < xyz.length; i += 3) {
    const radius = Math.hypot(xyz[i], xyz[i + 1]);
    if (!(radius > MIN_DISTANCE)) continue;
    const sector = Math.floor((Math.atan2(xyz[i + 1], xyz[i]) / (2 * Math.PI) + 0.5) * SHARP_SECTORS) % SHARP_SECTORS;
    const bin = Math.floor((degrees(Math.atan2(xyz[i + 2] - rise, radius)) / 180 + 0.5) * SHARP_BINS);
    counts[sector * SHARP_BINS + Math.min(bin, SHARP_BINS - 1)]++;
  }
  let pairs = 0, pairsTogether = 0;
  for (let i = 0; i < counts.length; i += BINS_TOGETHER) {
    const part = counts.subarray(i, i + BINS_TOGETHER), together = part.reduce((sum, count) => sum + count, 0);
    pairs += part.reduce((sum, count) => sum + count * (count - 1), 0);
    pairsTogether += together * (together - 1);
  }
  return pairs / Math.max(pairsTogether, 1);
}

/**
 * Return two distances by which a scan is moved up, metres: the first brings the sensor to the origin, the second
 * brings the ground to `usualHeight` below the origin.
 */
export function risesOf(frame, usualHeight) {
  const { height } = frame;
  if (height === null || usualHeight === null) return [0, 0];
  if (isOnGround(frame)) return [height - usualHeight, height - usualHeight];
  return [0, Math.abs(height - usualHeight) < SAME_HEIGHT ? 0 : height - usualHeight];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/** Return points (4 n) turned back from level to the tilt that the frame (pitch, roll) was found to have. */
export function tilted(points, { pitch, roll }) {
  if (!pitch && !roll) return points;
  const turn = rotation(pitch, roll), result = points.slice();
  for (let i = 0; i < points.length; i += 4) {
    const point = points.subarray(i, i + 3);
    for (let axis = 0; axis < 3; axis++) result[i + axis] = dot(point, turn.map((row) => row[axis]));
  }
  return result;
}

/** Return points (3 n) rotated by a (3, 3) matrix, float64. */
function turned(xyz, turn) {
  const result = new Float64Array(xyz.length);
  for (let i = 0; i < xyz.length; i += 3) {
    for (let axis = 0; axis < 3; axis++) {
      const [a, b, c] = turn[axis];
      result[i + axis] = a * xyz[i] + b * xyz[i + 1] + c * xyz[i + 2];
    }
  }
  return result;
}

/** Return the rotation by roll about x, then pitch about y, in degrees. */
function rotation(pitch, roll) {
  const [cp, sp, cr, sr] = [pitch, roll].flatMap((angle) => {
    const radians = (angle * Math.PI) / 180;
    return [Math.cos(radians), Math.sin(radians)];
  });
  return [[cp, sp * sr, sp * cr], [0, cr, -sr], [-sp, cp * sr, cp * cr]];
}

/** Return pitch and roll in degrees of the rotation that turns a vector to +z. */
function levelling([x, y, z]) {
  return [-degrees(Math.atan2(x, Math.hypot(y, z))), degrees(Math.atan2(y, z))];
}

/** Return the unit, m or mm, given the points (3 n): their distances tell it. */
function unitOf(xyz, name) {
  if (!xyz.length) return "m";
  const distances = Float64Array.from({ length: xyz.length / 3 }, (_, i) => Math.hypot(...xyz.subarray(3 * i, 3 * i + 3)));
  const [near, median, far] = quantilesOf(distances.sort(), [0.05, 0.5, 0.95]);

  // Points far from the origin are map coordinates, which `normalise` refuses.
  if (!(median > MAX_METRES_MEDIAN) || near > AROUND_SHARE * far) return "m";
  if (median > MIN_MILLIMETRES_MEDIAN) return "mm";
  throw new InputError(
    `${name}: expected metres from the sensor, found half of the points farther than ${median.toFixed(0)}; ` +
    "label it with amvnet predict and --unit cm or mm (or m, if they are metres)",
  );
}

/** Return the one of UP_AXES that gives the points a sure ground; x-forward if several do, as walls look like ground. */
function axesOf(xyz) {
  const sure = UP_AXES.filter((axes) => findGround(turned(xyz, AXES[axes]))?.isSure);
  return sure.length === 1 ? sure[0] : "x-forward";
}
