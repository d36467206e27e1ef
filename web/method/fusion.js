// Compare the two networks (section 3.2 of the paper), and merge their probabilities f and g (n K) (section 3.3).

const TINY = 1e-12;  // the least divisor, which keeps quotients finite

/** Return the cosine similarity (n) of the networks' probabilities. */
export function similarityOf(f, g, k) {
  return Float32Array.from({ length: f.length / k }, (_, i) => {
    let ff = 0, gg = 0, fg = 0;
    for (let at = i * k; at < (i + 1) * k; at++) { ff += f[at] * f[at]; gg += g[at] * g[at]; fg += f[at] * g[at]; }
    return Math.min(fg / Math.sqrt(Math.max(ff * gg, TINY)), 1);
  });
}

/**
 * Return the indices (u) of the uncertain points that the head classifies: at these, the networks name different classes, or
 * the best class of the mean is at most `lead` times as probable as the second. With a lead of 0, they are all uncertain points.
 */
export function disputedOf(f, g, k, uncertain, lead) {
  return Uint32Array.from(uncertain.keys()).filter((i) => {
    if (!uncertain[i] || !lead) return uncertain[i];
    const [ofF, ofG] = [f, g].map((values) => values.subarray(i * k, (i + 1) * k));
    const squares = ofF.map((value, c) => value * ofG[c]).sort();  // of the mean's probabilities, the largest last
    const isClose = Math.fround(squares[k - 2] * Math.fround(lead ** 2)) >= squares[k - 1];
    return isClose || labelsOf(ofF, k)[0] !== labelsOf(ofG, k)[0];
  });
}

/** Return the geometric mean (n K) of the networks' probabilities. */
export function geometricMean(f, g) {
  return f.map((value, place) => Math.sqrt(value * g[place]));
}

/**
 * Return the first (v) of some points (u) in each cube of space, whose edge is in metres, and the place (u) of each point's cube
 * among them. With an edge of 0, each point has a cube of its own.
 */
export function firstInCubes(points, index, edge) {
  const cubes = new Map(), first = [];
  const cube = index.map((i) => {
    const key = edge ? [0, 1, 2].map((axis) => Math.floor(points[4 * i + axis] / edge)).join() : i;
    if (!cubes.has(key)) cubes.set(key, first.push(i) - 1);
    return cubes.get(key);
  });
  return [Uint32Array.from(first), cube];
}

/** Return the mean (n K), in which the disputed points (u) have the head's probabilities (v K) of their cube (u). */
export function merged(mean, disputed, head, cube, k) {
  const scores = mean.slice();
  disputed.forEach((i, row) => scores.set(head.subarray(cube[row] * k, (cube[row] + 1) * k), i * k));
  return scores;
}

/** Return the id (n) of the most probable class, 1 to K. */
export function labelsOf(scores, k) {
  const largest = (row) => row.reduce((best, value, c) => (value > row[best] ? c : best), 0);
  return Uint8Array.from({ length: scores.length / k }, (_, i) => 1 + largest(scores.subarray(i * k, (i + 1) * k)));
}
