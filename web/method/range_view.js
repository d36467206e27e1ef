// The range view (section 3.1 of the paper): a scan as an image, with a row for each laser or elevation.

import { InputError } from "../errors.js";
import { elevationOf, rowAt } from "../sensor/rows.js";

const CHANNELS = 6;  // x, y, z, intensity, range, mask
const OFFSETS = [-2, -1, 0, 1, 2];  // the rows and columns of the window around a point's pixel
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
 * Project points (4 n) to a range image. Return {image, pixel}: the image (6, H, W) in float32, and the pixel (n) of
 * each point, counted row by row. A pixel shows its point nearest to the sensor; of equally near points, the first.
 */
export function rangeImage(view, points, rows) {
  const { height, width } = view, count = points.length / 4, plane = height * width;
  const image = new Float32Array(CHANNELS * plane), pixel = new Int32Array(count);
  checkRows(view, rows);

  for (let i = 0; i < count; i++) {
    const [x, y, z, intensity] = points.subarray(4 * i, 4 * i + 4), distance = distanceOf(points, i);
    const column = cellOf(0.5 - Math.atan2(y, x) / (2 * Math.PI), width);
    const row = rows ? rows[i] : rowAt(elevationOf(x, y, z), view);
    const place = (pixel[i] = row * width + column);
    if (distance < view.nearest || (image[5 * plane + place] && distance >= image[4 * plane + place])) continue;
    [x, y, z, intensity, distance, 1].forEach((value, channel) => (image[channel * plane + place] = value));
  }
  return { image, pixel };
}

function checkRows({ rows: kind, height }, rows) {
  if (kind === "ring" && !rows) {
    throw new InputError("expected a scan with a ring index, found none; use a model with rows by elevation");
  }
  if (!rows || rows.every((row) => row >= 0 && row < height)) return;
  const [low, high] = rows.reduce(([a, b], row) => [Math.min(a, row), Math.max(b, row)], [Infinity, -Infinity]);
  const found = `${height - 1 - high} to ${height - 1 - low}`;
  throw new InputError(`expected ring indices from 0 to ${height - 1}, found ${found}; use a model for this sensor`);
}

/**
 * Give the hidden points of a projection their probabilities, in `scores` (n K), which holds those of the points' pixels.
 *
 * A hidden point lies more than `hidden` metres behind the point that its pixel shows. It gets the mean of the pixels
 * around it, weighted by how near to its own distance they show a point. `scoresAt` returns the probabilities of pixels.
 */
export function scoreHidden({ height, width, hidden = 0 }, { image, pixel }, points, scores, scoresAt) {
  const plane = height * width, shown = image.subarray(4 * plane, 5 * plane), mask = image.subarray(5 * plane);
  pixel.forEach((own, i) => {
    const distance = distanceOf(points, i), row = own - (own % width), k = scores.length / pixel.length;
    if (!hidden || !mask[own] || Math.abs(shown[own] - distance) <= hidden) return;

    // The window continues at the other end of the image. Above and below it, no pixel has a mask.
    const window = OFFSETS.flatMap((y) => OFFSETS.map((x) => row + y * width + (((own % width) + x + width) % width)));
    const around = [own, ...window.filter((place) => mask[place])], values = scoresAt(around);
    const weights = around.map((place, n) => (n ? Math.exp(-(((shown[place] - distance) / hidden) ** 2)) : OWN_WEIGHT));
    const total = weights.reduce((sum, weight) => sum + weight);
    for (let c = 0; c < k; c++) scores[i * k + c] = weights.reduce((sum, weight, n) => sum + weight * values[n * k + c], 0) / total;
  });
  return scores;
}
