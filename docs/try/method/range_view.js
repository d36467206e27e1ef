// The range view (section 3.1 of the paper): a scan as an image, with a row for each laser or elevation.

import { InputError } from "../errors.js";
import { elevationOf, rowAt } from "../sensor/rows.js";

const CHANNELS = 6;  // x, y, z, intensity, range, mask
const WINDOW = 5;  // height and width of the window around a point's pixel, pixels
const OWN_WEIGHT = 1e-3;  // the weight of a hidden point's own pixel

/** Return the distance from the sensor to point i of points (4 n), metres, in float32 as in the training. */
export function distanceOf(points, i) {
  const [x, y, z] = points.subarray(4 * i, 4 * i + 3), add = (a, b) => Math.fround(a + b);
  return Math.fround(Math.sqrt(add(add(Math.fround(x * x), Math.fround(y * y)), Math.fround(z * z))));
}

/** Divide [0, 1] into equal cells; return the number of the cell that holds a share, or the nearest cell. */
export function cellOf(share, cells) {
  return Math.min(Math.max(Math.floor(share * cells), 0), cells - 1);
}

/**
 * Project points (4 n) to a range image. Return {image, pixel, distances}: the image (6, H, W) in float32, the pixel (n)
 * of each point, counted row by row, and its distance (n) from the sensor. A pixel shows its point nearest to the sensor; of equally near points, the first.
 */
export function rangeImage(view, points, rows) {
  const { height, width } = view, count = points.length / 4, plane = height * width;
  const image = new Float32Array(CHANNELS * plane), pixel = new Int32Array(count);
  const distances = new Float32Array(count);
  const nearest = new Float32Array(plane).fill(Infinity);
  checkRows(view, rows);

  for (let i = 0; i < count; i++) {
    const [x, y, z, intensity] = points.subarray(4 * i, 4 * i + 4), distance = (distances[i] = distanceOf(points, i));
    const column = cellOf(0.5 - Math.atan2(y, x) / (2 * Math.PI), width);
    const row = rows ? rows[i] : rowAt(elevationOf(x, y, z), view);
    const place = (pixel[i] = row * width + column);
    if (distance < view.nearest || distance >= nearest[place]) continue;
    nearest[place] = distance;
    [x, y, z, intensity, distance, 1].forEach((value, channel) => (image[channel * plane + place] = value));
  }
  return { image, pixel, distances };
}

function checkRows({ rows: kind, height }, rows) {
  if (kind === "ring" && !rows) {
    throw new InputError("expected a scan with a ring index, found none; use a model with rows by elevation");
  }
  if (!rows || rows.every((row) => row >= 0 && row < height)) return;
  const [low, high] = rows.reduce(([a, b], row) => [Math.min(a, row), Math.max(b, row)], [Infinity, -Infinity]);
  throw new InputError(
    `expected ring indices from 0 to ${height - 1}, found ${height - 1 - high} to ${height - 1 - low}; ` +
    "use a model for this sensor",
  );
}

/** Return the values (H W, K) of the pixels of an image (K, H, W). */
export function byPixel(image, k) {
  const plane = image.length / k, values = new Float32Array(image.length);
  for (let c = 0; c < k; c++) {
    for (let i = 0; i < plane; i++) values[i * k + c] = image[c * plane + i];
  }
  return values;
}

/**
 * Return the probabilities (n K) of the points of a projection, given the probabilities (H W, K) of its pixels. A point
 * has the probabilities of its pixel. A hidden point, whose pixel shows another point more than `hidden` metres before
 * it, has the mean of the pixels around, weighted by how near to its own distance they show a point.
 */
export function toPoints({ height, width, hidden = 0 }, { image, pixel, distances }, scores, k) {
  const plane = height * width, shown = image.subarray(4 * plane, 5 * plane), mask = image.subarray(5 * plane);
  const values = new Float32Array(pixel.length * k);
  pixel.forEach((own, i) => {
    const row = values.subarray(i * k, (i + 1) * k).fill(0);
    let total = 0;
    const add = (place, weight) => {
      total += weight;
      for (let c = 0; c < k; c++) row[c] += weight * scores[place * k + c];
    };
    const isHidden = hidden > 0 && mask[own] && Math.abs(shown[own] - distances[i]) > hidden;
    add(own, isHidden ? OWN_WEIGHT : 1);
    if (isHidden) {
      for (const place of windowAround(own, height, width)) {
        if (mask[place]) add(place, Math.exp(-(((shown[place] - distances[i]) / hidden) ** 2)));
      }
    }
    for (let c = 0; c < k; c++) row[c] /= total;
  });
  return values;
}

/** Return the pixels of the window around a pixel. It continues at the other end of the image, but not above or below. */
function windowAround(pixel, height, width) {
  const half = (WINDOW - 1) / 2, row = Math.floor(pixel / width), column = pixel % width, places = [];
  for (let y = Math.max(row - half, 0); y <= Math.min(row + half, height - 1); y++) {
    for (let x = column - half; x <= column + half; x++) places.push(y * width + ((x + width) % width));
  }
  return places;
}
