// Read scan files that hold only rows of float32: KITTI's (x, y, z, intensity) and nuScenes' (also the ring).

import { InputError } from "../errors.js";
import { checkPointCount, makeCloud, ringIndices } from "./cloud.js";

export const COLUMNS = ["x", "y", "z", "intensity", "ring"];
const KITTI = 4, NUSCENES = 5;  // the number of columns of each layout
const NAMED_NUSCENES = ".pcd.bin";
const FEWEST_BYTES = 4800;  // the least size of a file whose values can show that no layout fits, bytes
const ADVICE = "save it as a .pcd or .ply file, or label it with amvnet predict and --columns";

// These limits tell coordinates and intensities from other columns, and float32 from other types.
const MAX_INTENSITY = 65535;  // the largest intensity that any sensor writes
const NEAR = 500;  // the limit of coordinates in usual scans, metres
const NO_INTENSITY = -1;  // the intensity that some tools write for a lost return; no other is negative
const USUAL_SHARE = 0.999;  // the least share of points within these limits; the others are outliers

// These limits tell ring indices from labels: lasers have similar numbers of points, or each has one elevation.
const LARGEST_RING = 2.5;  // largest number of points of a ring, relative to the mean ring
const FEWEST_LASERS = 8;  // the fewest lasers; fewer classes may also have similar numbers of points
const ELEVATION_SPREAD = 0.1;  // the largest variance of the elevations within a ring, relative to the scan's variance

/** Return the cloud of rows in the layout that the values fit. */
export function readRaw(bytes, name) {
  checkPointCount(Math.floor(bytes.length / (4 * NUSCENES)), name);  // before anything is copied
  const isNamed = name.toLowerCase().endsWith(NAMED_NUSCENES);
  const kitti = columnsOf(bytes, KITTI), nuscenes = columnsOf(bytes, NUSCENES);
  let columns = null;
  if (nuscenes && isNuscenes(nuscenes, isNamed)) columns = nuscenes;
  else if (kitti && isKitti(kitti)) columns = kitti;
  else if (bytes.length < FEWEST_BYTES) columns = isNamed ? nuscenes : kitti;
  if (!columns) throw new InputError(`${name}: ${whyNeither(bytes.length, isNamed, kitti ?? nuscenes)}`);

  checkPointCount(columns[0].length, name);
  return makeCloud(Object.fromEntries(columns.map((values, place) => [COLUMNS[place], { values, isInteger: false }])), name);
}

function whyNeither(size, isNamed, found) {
  if (size < FEWEST_BYTES) {
    const width = isNamed ? NUSCENES : KITTI, names = COLUMNS.slice(0, width).join(" ");
    const expected = `expected rows of ${width} float32, columns ${names}`;
    return `${expected}, found ${size} bytes, which is no multiple of ${4 * width}; ${ADVICE}, or copy the file again`;
  }
  const expected = "expected rows of float32 x, y, z, intensity (KITTI), ring (nuScenes), found";
  if (found?.every((values) => !values.some(Number.isFinite))) return `${expected} no finite number; record the scan again`;
  if (size % (4 * KITTI) === 0 || size % (4 * NUSCENES) === 0) return `${expected} values that fit neither; ${ADVICE}`;
  const sizes = `${size} bytes, which is a multiple of neither ${4 * KITTI} nor ${4 * NUSCENES}`;
  return `${expected} ${sizes}; copy the file again if it is truncated, or ${ADVICE}`;
}

/** Return the columns (n each) of rows of float32; null if the bytes are no whole number of rows. */
function columnsOf(bytes, width) {
  if (bytes.length % (4 * width)) return null;
  const rows = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4), count = rows.length / width;
  return COLUMNS.slice(0, width).map((_, column) => Float32Array.from({ length: count }, (_, row) => rows[width * row + column]));
}

/** Return whether columns can be x, y, z, intensity and ring. Unless `isNamed`, rings must not look like labels. */
function isNuscenes([x, y, z, intensity, values], isNamed) {
  if (!values.every(Number.isInteger) || !intensity.every(isIntensity)) return false;
  const ring = ringIndices(values), isFraction = [x, y, z].some((axis) => !axis.every(Number.isInteger));
  return ring !== null && isFraction && (isNamed || areRings(x, y, z, ring));
}

/** Return whether whole numbers are the rings of the points instead of their labels. */
export function areRings(x, y, z, ring) {
  const [counts, sums, squares] = [0, 1, 2].map(() => new Float64Array(256));
  ring.forEach((laser, i) => {
    const elevation = Number.isFinite(x[i] + y[i] + z[i]) ? Math.atan2(z[i], Math.hypot(x[i], y[i])) : 0;
    counts[laser]++;
    sums[laser] += elevation;
    squares[laser] += elevation * elevation;
  });
  const lasers = [...counts.keys()].filter((laser) => counts[laser]), extent = lasers.at(-1) - lasers[0];
  const isEven = Math.max(...counts) * lasers.length <= LARGEST_RING * ring.length;
  if (lasers.length >= FEWEST_LASERS && extent < 2 * lasers.length && isEven) return true;

  const total = (values) => values.reduce((sum, value) => sum + value, 0);
  const within = total(lasers.map((laser) => squares[laser] - sums[laser] ** 2 / counts[laser]));
  return within <= ELEVATION_SPREAD * (total(squares) - total(sums) ** 2 / ring.length);
}

/** Return whether columns can be x, y, z and intensity. Some coordinates are negative; lost points may not be finite. */
function isKitti([x, y, z, intensity]) {
  const isNear = (i) => Math.abs(x[i]) < NEAR && Math.abs(y[i]) < NEAR && Math.abs(z[i]) < NEAR;
  let usual = 0;
  for (let i = 0; i < x.length; i++) {
    const isLost = !(Number.isFinite(x[i]) && Number.isFinite(y[i]) && Number.isFinite(z[i]));
    if ((isLost || isNear(i)) && isIntensity(intensity[i])) usual++;
  }
  return [x, y, z].some((axis) => axis.some((value) => value < 0)) && usual >= USUAL_SHARE * x.length;
}

/** Return whether a value can be an intensity, also of a lost point. */
function isIntensity(value) {
  return (value >= 0 && value <= MAX_INTENSITY) || value === NO_INTENSITY || !Number.isFinite(value);
}
