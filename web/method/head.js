// The point head (section 3.3 of the paper) decides disputed points by the scores of both networks around them.

const HEAD_BATCH = 2048;  // the number of disputed points that are classified at a time, which limits the memory

/**
 * Return the head's probabilities (u K) of disputed points (u), given the points (4 p), both networks' probabilities
 * f and g (p K), and the neighbours (u n) of the disputed points.
 */
export async function classify(networks, { points, f, g, disputed, neighbours }) {
  const { k, description } = networks, scale = Math.fround(description.point_head.position_scale);
  const width = 2 * k + 4, n = neighbours.length / disputed.length, scores = new Float32Array(disputed.length * k);

  const fill = (target, start, i) =>
    [f.subarray(i * k, (i + 1) * k), g.subarray(i * k, (i + 1) * k), points.subarray(4 * i, 4 * i + 4)]
      .forEach((values, part) => target.set(values, start + part * k));
  for (let first = 0; first < disputed.length; first += HEAD_BATCH) {
    const part = disputed.subarray(first, first + HEAD_BATCH);
    const point = new Float32Array(part.length * width), rows = new Float32Array(part.length * n * width);
    part.forEach((i, row) => {
      for (let rank = 0; rank < n; rank++) {
        const start = (row * n + rank) * width;
        fill(rows, start, neighbours[(first + row) * n + rank]);
        // x, y, z and intensity of neighbours are relative to the point.
        for (let axis = 0; axis < 4; axis++) rows[start + 2 * k + axis] -= points[4 * i + axis];
      }
      fill(point, row * width, i);
      for (let axis = 0; axis < 3; axis++) point[row * width + 2 * k + axis] *= scale;
    });
    scores.set(await networks.scorePoints(point, rows, part.length), first * k);
  }
  return scores;
}
