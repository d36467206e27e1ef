// The bird's-eye view (section 3.1 of the paper; PolarNet): a scan in a polar grid of pillars, divided into voxels.

import { cellOf, distanceOf } from "./range_view.js";

// The number of features of a point: offsets to the centre of its cell (3), radius, angle, z, x, y, intensity.
export const FEATURES = 9;

/**
 * Sort points (4 n) into the polar grid. Return {features, pillar, voxel, isSeen}: the features (9 n), the pillar of
 * each point, its voxel within the pillar, and whether it is far enough from the sensor to be seen.
 */
export function polarGrid(view, points) {
  const count = points.length / 4, features = new Float32Array(FEATURES * count);
  const pillar = new Int32Array(count), voxel = new Int32Array(count), isSeen = new Uint8Array(count);
  const low = [view.radius_min, -Math.PI, view.z_min], high = [view.radius_max, Math.PI, view.z_max];
  const cells = [view.radial, view.angular, view.vertical];

  for (let i = 0; i < count; i++) {
    const [x, y, z, intensity] = points.subarray(4 * i, 4 * i + 4);
    const polar = [Math.sqrt(x * x + y * y), Math.atan2(y, x), z];
    const cell = polar.map((value, axis) => cellOf((value - low[axis]) / (high[axis] - low[axis]), cells[axis]));
    const centre = cell.map((value, axis) => low[axis] + ((value + 0.5) * (high[axis] - low[axis])) / cells[axis]);
    features.set([...polar.map((value, axis) => value - centre[axis]), ...polar, x, y, intensity], FEATURES * i);
    pillar[i] = cell[0] * view.angular + cell[1];
    voxel[i] = cell[2];
    isSeen[i] = distanceOf(points, i) >= view.nearest;
  }
  return { features, pillar, voxel, isSeen };
}

/** Add the features (n C) of points in pillars (n) to the maxima of each pillar, a Map of arrays (C). */
export function addToMaxima(maxima, pillar, features) {
  const channels = features.length / pillar.length;
  pillar.forEach((place, i) => {
    const feature = features.subarray(i * channels, (i + 1) * channels), largest = maxima.get(place);
    if (!largest) maxima.set(place, feature.slice());
    else for (let c = 0; c < channels; c++) if (feature[c] > largest[c]) largest[c] = feature[c];
  });
}

/** Return a map (C, R A) that has the values (m C) at the pillars (m), and zeros elsewhere. */
export function toMap(values, pillars, size) {
  const channels = values.length / pillars.length, map = new Float32Array(channels * size);
  pillars.forEach((pillar, row) => {
    for (let c = 0; c < channels; c++) map[c * size + pillar] = values[row * channels + c];
  });
  return map;
}

/** Return the values (m C) of a map (C, size) at some cells (m). */
export function atCells(map, cells, size) {
  const channels = map.length / size, values = new Float32Array(cells.length * channels);
  cells.forEach((cell, row) => {
    for (let c = 0; c < channels; c++) values[row * channels + c] = map[c * size + cell];
  });
  return values;
}
