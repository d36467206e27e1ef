// Compare the two networks (section 3.2 of the paper), and merge their probabilities f and g (n K) (section 3.3).

const TINY = 1e-12;  // the least divisor, which keeps quotients finite

/** Return the cosine similarity (n) of the networks' probabilities. */
export function similarityOf(f, g, k) {
  const similarity = new Float32Array(f.length / k);
  for (let i = 0; i < similarity.length; i++) {
    let ff = 0, gg = 0, fg = 0;
    for (let place = i * k; place < (i + 1) * k; place++) {
      ff += f[place] * f[place];
      gg += g[place] * g[place];
      fg += f[place] * g[place];
    }
    similarity[i] = Math.min(fg / Math.sqrt(Math.max(ff * gg, TINY)), 1);
  }
  return similarity;
}

/**
 * Return the indices (u) of the uncertain points that the head classifies: at these, the networks name different classes, or
 * the best class of the mean is at most `lead` times as probable as the second. With a lead of 0, they are all uncertain points.
 */
export function disputedOf(f, g, k, uncertain, lead) {
  const all = Uint32Array.from(uncertain.keys()).filter((i) => uncertain[i]), squared = Math.fround(lead ** 2);
  return !lead ? all : all.filter((i) => {
    let inF = i * k, inG = i * k, best = -1, second = -1;  // places of the largest; squares of the mean's probabilities
    for (let place = i * k; place < (i + 1) * k; place++) {
      if (f[place] > f[inF]) inF = place;
      if (g[place] > g[inG]) inG = place;
      const square = Math.fround(f[place] * g[place]);
      if (square > best) [best, second] = [square, best];
      else if (square > second) second = square;
    }
    return inF !== inG || Math.fround(second * squared) >= best;
  });
}

/** Return the geometric mean (n K) of the networks' probabilities. */
export function geometricMean(f, g) {
  return f.map((value, place) => Math.sqrt(value * g[place]));
}

/** Return the mean (n K), in which the disputed points (u) have the probabilities of the head (u K). */
export function merged(mean, disputed, head, k) {
  const scores = mean.slice();
  disputed.forEach((i, row) => scores.set(head.subarray(row * k, (row + 1) * k), i * k));
  return scores;
}

/** Return the id (n) of the most probable class, 1 to K. */
export function labelsOf(scores, k) {
  const labels = new Uint8Array(scores.length / k);
  for (let i = 0; i < labels.length; i++) {
    let best = i * k;
    for (let place = best + 1; place < (i + 1) * k; place++) if (scores[place] > scores[best]) best = place;
    labels[i] = best - i * k + 1;
  }
  return labels;
}
