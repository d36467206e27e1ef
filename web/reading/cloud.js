// The points of a scan file, before anything is assumed of the sensor.
//
// A column is {values, isInteger}: a typed array with a number per point, and whether the file stores integers.
// A cloud is {name, count, xyz, intensity, ring}. xyz (3 count) holds x, y, z of each point, in float32 if the file has
// float32, else in float64. intensity is a column, and ring (count) holds the index of each point's laser; both may be
// null.

import { counted, InputError, quoted } from "../errors.js";

// The largest number of points of a scan. A page has less memory than a program: `amvnet predict` reads ten million points.
export const MAX_POINTS = 1_000_000;
const MAX_MISSING_SHARE = 0.5;  // the share of missing intensities above which a scan counts as one without intensities
const MAX_RINGS = 256;  // largest number of lasers; a column with larger values does not hold ring indices

// The possible names of each column; the first name that a file has is read.
const NAMES = {
  x: ["x"],
  y: ["y"],
  z: ["z"],
  intensity: ["intensity", "intensities", "i", "reflectivity", "reflectance", "remission", "scalar_intensity"],
  ring: ["ring", "rings", "channel", "laser_id", "laser", "scalar_ring"],
};

/** Check the number of points that a header claims; a file of `size` bytes must have at least `least`. */
export function checkPointCount(count, name, size = 0, least = 0) {
  if (!(count >= 0 && count <= MAX_POINTS)) {
    const most = counted(MAX_POINTS);
    throw new InputError(`${name}: expected a scan of at most ${most} points, found ${count}; split it into scans`);
  }
  if (least > size) {
    throw new InputError(
      `${name}: expected at least ${least} bytes for ${count} points, found ${size}; ` +
      "the file is truncated, copy it again",
    );
  }
}

/** Return {x: index, ...}: the indices of the columns to read, given the names of a file's columns. */
export function requireColumns(names, name) {
  const lower = names.map((each) => each.toLowerCase()), found = {};
  for (const [key, aliases] of Object.entries(NAMES)) {
    const alias = aliases.find((each) => lower.includes(each));
    if (alias) found[key] = lower.indexOf(alias);
  }
  if (!("x" in found && "y" in found && "z" in found)) {
    const listing = names.slice(0, 20).join(", ") || "none";
    throw new InputError(`${name}: expected columns x, y, z, found ${quoted(listing, 200)}; rename the columns`);
  }
  return found;
}

/** Return the cloud of the columns {x, y, z, intensity, ring}; intensity and ring may be missing. */
export function makeCloud(columns, name) {
  const axes = [columns.x, columns.y, columns.z], count = axes[0].values.length;
  const isFloat32 = axes.every(({ values }) => values instanceof Float32Array);
  const xyz = new (isFloat32 ? Float32Array : Float64Array)(3 * count);
  axes.forEach(({ values }, axis) => {
    for (let i = 0; i < count; i++) xyz[3 * i + axis] = values[i];
  });
  const ring = columns.ring ? ringIndices(columns.ring.values) : null;
  return { name, count, xyz, intensity: columns.intensity ?? null, ring };
}

/** Return values as ring indices, 0 for NaN; null if all are equal, or one is negative, not whole or too large. */
export function ringIndices(values) {
  const ring = Uint8Array.from(values, (value) => (Number.isFinite(value) ? value : 0));
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < values.length; i++) {
    const value = Number.isFinite(values[i]) ? values[i] : 0;
    if (value !== ring[i]) return null;  // a byte holds only whole numbers below MAX_RINGS
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return low < high && high < MAX_RINGS ? ring : null;
}

/** Return whether the point at xyz[start] has finite coordinates other than 0, 0, 0, which lost returns have. */
export function isPlaced(xyz, start) {
  const [x, y, z] = [xyz[start], xyz[start + 1], xyz[start + 2]];
  return Number.isFinite(x) && Number.isFinite(y) && Number.isFinite(z) && (x !== 0 || y !== 0 || z !== 0);
}

/**
 * Return the finite intensities of the points with a place, ascending, or none if most are missing; and the number of
 * points with a place. Intensities of lost returns mean nothing.
 */
export function measuredIntensities({ xyz, intensity }) {
  if (!intensity) return { measured: new Float64Array(0), placed: 0 };
  const values = Float64Array.from(intensity.values).filter((_, i) => isPlaced(xyz, 3 * i)), placed = values.length;
  const measured = values.filter(Number.isFinite).sort(), areMissing = placed - measured.length > MAX_MISSING_SHARE * placed;
  return { measured: areMissing ? new Float64Array(0) : measured, placed };
}
