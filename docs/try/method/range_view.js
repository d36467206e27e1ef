// The range view (section 3.1 of the paper): a scan as an image, with a row for each laser or elevation.

import { InputError } from "../errors.js";
import { elevationOf, rowAt } from "../sensor/rows.js";

const CHANNELS = 6;  // x, y, z, intensity, range, mask

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
  const nearest = new Float32Array(plane).fill(Infinity);
  checkRows(view, rows);

  for (let i = 0; i < count; i++) {
    const [x, y, z, intensity] = points.subarray(4 * i, 4 * i + 4), distance = distanceOf(points, i);
    const column = cellOf(0.5 - Math.atan2(y, x) / (2 * Math.PI), width);
    const row = rows ? rows[i] : rowAt(elevationOf(x, y, z), view);
    const place = (pixel[i] = row * width + column);
    if (distance < view.nearest || distance >= nearest[place]) continue;
    nearest[place] = distance;
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
  throw new InputError(
    `expected ring indices from 0 to ${height - 1}, found ${height - 1 - high} to ${height - 1 - low}; ` +
    "use a model for this sensor",
  );
}

/** Return the logits (n K) of the points, which they take from their pixels in an image (K, H, W). */
export function atPixels(scores, pixel, k) {
  const plane = scores.length / k, logits = new Float32Array(pixel.length * k);
  for (let c = 0; c < k; c++) {
    for (let i = 0; i < pixel.length; i++) logits[i * k + c] = scores[c * plane + pixel[i]];
  }
  return logits;
}
